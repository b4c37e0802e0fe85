"""Noise that grows with the speed of its channel: turbulence of a flow, or samples that jitter.

It is white like the noise at rest, but its density follows the motion. A signal that is merely
lively has no plateau while it moves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pamctl.diagnose.measured.noise.spectrum import find_tail
from pamctl.diagnose.measured.noise.time_stamps import cut_even_stretches
from pamctl.diagnose.measured.record import Array, Record

WINDOW = 34
"""Samples whose speed counts as one."""
FAST = 0.125
"""Share of the windows that count as fast, and as slow."""
VAGUE = 0.15
"""A tail that is less certain than this, relative, says nothing."""
UNEVEN = 2.0
"""Growth below this multiple of the scatter of the periods comes from the times of the samples."""
LOUDER = 1.6
"""Variance of the noise of fast windows over that of slow ones, from which it counts."""


def measure_growth(records: Sequence[Record], channel: str, deviation: float, step: float) -> float:
    """Return further noise over the change from one sample to the next; 0 where none shows.

    `deviation` is the noise at rest, with the rounding to `step`.
    """
    windows = _cut_windows(records, channel)
    if len(windows) < 40:
        return 0.0
    change = np.abs(windows[:, -1] - windows[:, 0]) / (WINDOW - 1)
    order = np.argsort(change)
    count = int(FAST * len(windows))
    slow, fast = windows[order[:count]], windows[order[-count:]]
    still, moving = (find_tail([*part], WINDOW - 2) for part in (slow, fast))
    if still is None or moving is None or not moving.is_flat or moving.uncertainty > VAGUE:
        return 0.0
    quiet = max(still.deviation**2, deviation**2, step**2 / 12.0)
    excess = moving.deviation**2 - quiet
    if excess < max((LOUDER - 1.0) * quiet, step**2):
        return 0.0
    growth = float(np.sqrt(excess / np.median(change[order[-count:]] ** 2)))
    # Samples that are not evenly apart look noisy as well, but their times are known.
    uneven = float(np.median([np.std(np.diff(r.step_s)) / r.period_s for r in records]))
    return growth if growth > UNEVEN * uneven else 0.0


def _cut_windows(records: Sequence[Record], channel: str) -> Array:
    parts = [r[channel][part] for r in records for part in cut_even_stretches(r)]
    whole = [p[: len(p) // WINDOW * WINDOW].reshape(-1, WINDOW) for p in parts]
    return np.concatenate(whole) if whole else np.zeros((0, WINDOW))
