"""From windows to an alarm: a cumulative sum for each block and activity.

One window a little over its limit is chance; several are not. Each activity has a sum of its own:
a rest between two motions then neither adds to what the motions show, nor hides it.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from pamctl.monitor.judge_window import MECHANICS, PRESSURE, WindowMisfit

ALLOWANCE = 0.75
"""A window must be this many deviations over its limit to count."""
ALARM = 6.0
"""Sums of faultless rigs stayed below 2.5: see the manual, watch-a-rig-for-changes."""
MOST_OF_ONE = 6.0
"""No single window raises the alarm, however far off it is."""
LEAST_OF_ONE = -3.0
FULL = 2.0 * ALARM
"""A sum grows no further: an alarm whose cause is mended ends within some windows."""
SMALLEST_SPREAD = {PRESSURE: 0.1, MECHANICS: 0.15}
"""Deviation of a window's logarithm, at least."""
RESTING = 3.0
"""Where too little moves to confirm the model, a window counts this many times less: friction holds
one state for long, and all windows of it are alike."""
REMEMBERED = 30
"""Windows of the same activity whose scatter counts."""


@dataclass(frozen=True)
class MisfitAlarm:
    """A block has left the model."""

    block: str
    activity: str
    since_s: float
    """Start of the first window that counted."""
    over_floor: float
    """Misfit over the floor, both as RMS over the windows since then."""
    rms: float
    """Misfit, Pa or m."""


@dataclass
class _Sum:
    value: float = 0.0
    is_raised: bool = False
    squares: list[tuple[float, float]] = field(default_factory=list)
    since_s: float = 0.0
    spreads: list[float] = field(default_factory=list)

    def take(self, misfit: WindowMisfit, start_s: float) -> None:
        self.spreads = [*self.spreads[1 - REMEMBERED :], misfit.spread]
        scatter = float(np.sqrt(np.mean(np.square(self.spreads))))
        deviations = misfit.excess / max(SMALLEST_SPREAD[misfit.block], scatter)
        if not misfit.shows:
            deviations /= RESTING
        score = float(np.clip(deviations, LEAST_OF_ONE, MOST_OF_ONE)) - ALLOWANCE
        if self.value <= 0.0:
            self.squares, self.since_s = [], start_s
        self.value = float(np.clip(self.value + score, 0.0, FULL))
        self.squares = [*self.squares[1 - REMEMBERED :], (misfit.rms**2, misfit.floor**2)]
        self.is_raised = self.value > ALARM or (self.is_raised and self.value > 0.0)


class MisfitSums:
    """The sums of one rig, which go on from run to run."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, str], _Sum] = defaultdict(_Sum)

    def take(self, misfit: WindowMisfit, start_s: float) -> None:
        """Add a window that began at `start_s`, on any clock that goes on from run to run."""
        self._sums[misfit.block, misfit.activity].take(misfit, start_s)

    def find_alarm(self, block: str) -> MisfitAlarm | None:
        """Return the alarm of a block: since the first of its activities, of the worst one."""
        raised = {a: s for (b, a), s in self._sums.items() if b == block and s.is_raised}
        if not raised:
            return None
        activity, worst = max(raised.items(), key=lambda item: _ratio_of(item[1]))
        rms = float(np.sqrt(np.mean([square for square, _ in worst.squares])))
        since_s = min(s.since_s for s in raised.values())
        return MisfitAlarm(block, activity, since_s, _ratio_of(worst), rms)


def _ratio_of(one: _Sum) -> float:
    squares = np.array(one.squares)
    return float(np.sqrt(squares[:, 0].sum() / max(squares[:, 1].sum(), 1e-30)))
