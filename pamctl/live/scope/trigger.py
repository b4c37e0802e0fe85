"""Find the tick at which a signal crosses a level."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Slope = Literal["rising", "falling", "either"]


class Armed(NamedTuple):
    """Whether the signal was on the near side of the level, beyond the hysteresis."""

    rising: bool = False
    falling: bool = False


class Crossing(NamedTuple):
    """The result of a search."""

    at: int | None
    """Index of the first value at or beyond the level; None if there is none."""
    armed: Armed
    """For the search in the values that follow."""


def find_crossing(
    values: NDArray[np.float64],
    level: float,
    slope: Slope,
    hysteresis: float = 0.0,
    armed: Armed | None = None,
) -> Crossing:
    """Find the first crossing of `level` in `values` of shape (n,).

    A rising crossing is the first value at or above the level, after one that was below it by
    more than `hysteresis`; a falling one is its mirror image. NaN neither arms nor crosses. A
    search in pieces, each with the `armed` of the one before, finds what a search in one finds.
    """
    before = armed or Armed()
    rising, is_rising_armed = _find_rise(values, level, hysteresis, before.rising)
    falling, is_falling_armed = _find_rise(-values, -level, hysteresis, before.falling)
    found = {"rising": [rising], "falling": [falling], "either": [rising, falling]}[slope]
    index = min((at for at in found if at is not None), default=None)
    return Crossing(index, Armed(is_rising_armed, is_falling_armed))


def _find_rise(
    values: NDArray[np.float64], level: float, hysteresis: float, armed: bool
) -> tuple[int | None, bool]:
    start = 0
    if not armed:
        below = np.flatnonzero(values < level - hysteresis)
        if not len(below):
            return None, False
        start = int(below[0])
    above = np.flatnonzero(values[start:] >= level)
    return (start + int(above[0]), False) if len(above) else (None, True)
