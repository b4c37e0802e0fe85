"""The differences between a log and its replay, by field: the first, the number, the largest."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.replay.tolerance import Tolerances

Floats = NDArray[np.float64]

STAGES = (
    "zero",
    "measurement",
    "reference",
    "estimate",
    "command",
    "decision",
    "outcome",
    "keyframe",
)
"""The stages in the order of a tick: a difference in one stage may cause differences in later ones.

`zero` is what the sensors read at the vented muscle, `keyframe` the frozen state after a tick.
"""

_AROUND = 3


class StageField(NamedTuple):
    """A field of a stage."""

    stage: str
    name: str


class Pair(NamedTuple):
    """A logged value and the replayed one."""

    tick: int
    """Place of the tick in the log, from 0."""
    logged: float
    replayed: float


class Difference(NamedTuple):
    """The summary of a field that differs."""

    place: StageField
    first: Pair
    around: tuple[Pair, ...]
    """The compared ticks around the first difference."""
    ticks: int
    """Number of ticks that differ."""
    largest: float
    """The largest difference; infinite if only one of the two values is a number."""


class Differences:
    """Collects the differences of a replay, stretch by stretch."""

    def __init__(self, tolerances: Tolerances) -> None:
        """A field without a tolerance must be equal to the bit; NaN equals NaN."""
        self._tolerances = tolerances
        self._found: dict[StageField, Difference] = {}
        self._last: dict[StageField, tuple[Pair, ...]] = {}
        self.compared: dict[StageField, None] = {}
        """Every compared field, in the order of comparison."""

    def take(self, place: StageField, tick: int, logged: Floats, replayed: Floats) -> None:
        """Compare a field from tick `tick` on; both arrays have shape (n,)."""
        self.compared[place] = None
        wrong = find_differing(logged, replayed, self._tolerances.get(place.name, 0.0))
        if wrong is not None:
            self._note(place, tick, logged, replayed, wrong)
        else:
            self._last[place] = _make_pairs(
                tick, logged, replayed, len(logged) - _AROUND, len(logged)
            )

    def _note(
        self,
        place: StageField,
        tick: int,
        logged: Floats,
        replayed: Floats,
        wrong: NDArray[np.bool_],
    ) -> None:
        ticks, largest = int(wrong.sum()), _find_largest(logged[wrong], replayed[wrong])
        before = self._found.get(place)
        if before is not None:
            self._found[place] = before._replace(
                ticks=before.ticks + ticks, largest=max(before.largest, largest)
            )
            return
        at = int(wrong.argmax())
        first = Pair(tick + at, float(logged[at]), float(replayed[at]))
        near = _make_pairs(tick, logged, replayed, at - _AROUND, at + _AROUND + 1)
        earlier = self._last.get(place, ())
        around = tuple(pair for pair in (*earlier, *near) if abs(pair.tick - first.tick) <= _AROUND)
        self._found[place] = Difference(place, first, around, ticks, largest)

    def all(self) -> tuple[Difference, ...]:
        """Return the differences in the order of their first tick, within a tick by stage."""
        places = list(self.compared)

        def order(difference: Difference) -> tuple[int, int, int]:
            place = difference.place
            return difference.first.tick, STAGES.index(place.stage), places.index(place)

        return tuple(sorted(self._found.values(), key=order))


def find_differing(
    logged: Floats, replayed: Floats, tolerance: float = 0.0
) -> NDArray[np.bool_] | None:
    """Tell for each of n values whether the two are too far apart; None if none are."""
    same_bits = logged.view(np.int64) == replayed.view(np.int64)
    if same_bits.all():
        return None
    both_nan = np.isnan(logged) & np.isnan(replayed)
    wrong = ~(same_bits | both_nan)
    if tolerance:
        with np.errstate(invalid="ignore"):
            wrong &= ~(np.abs(logged - replayed) <= tolerance)
    return wrong if wrong.any() else None


def _find_largest(logged: Floats, replayed: Floats) -> float:
    with np.errstate(invalid="ignore"):
        apart = np.abs(logged - replayed)
    return float(np.where(np.isnan(apart), np.inf, apart).max())


def _make_pairs(
    tick: int, logged: Floats, replayed: Floats, begin: int, end: int
) -> tuple[Pair, ...]:
    near = slice(max(0, begin), end)
    values = zip(logged[near].tolist(), replayed[near].tolist(), strict=True)
    return tuple(Pair(tick + near.start + i, *pair) for i, pair in enumerate(values))


def are_within_tolerance(tolerances: Tolerances, differences: Iterable[Difference]) -> bool:
    """Tell whether these tolerances would accept all of the differences."""
    return all(
        difference.largest <= tolerances.get(difference.place.name, 0.0)
        for difference in differences
    )
