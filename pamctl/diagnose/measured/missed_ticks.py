"""Missed ticks: intervals that are whole multiples of the period, without samples within.

A filter counts samples, not seconds. Over a missed tick it would take the next sample for a
neighbour, and would bend a motion that is straight.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.measured.record import Array
from pamctl.plant.drive import find_period_s

LONG_PERIODS = 1.5
"""An interval longer than this has missed ticks."""


def find_long_intervals(step_s: Array) -> NDArray[np.bool_]:
    """Return which intervals have missed ticks, shape (n - 1,)."""
    long: NDArray[np.bool_] = step_s > LONG_PERIODS * find_period_s(step_s)
    return long


def smooth_over_missed(values: Array, step_s: Array, smooth: Callable[[Array], Array]) -> Array:
    """Apply a filter that takes its samples as evenly spaced; missed ones are filled by lines."""
    if not find_long_intervals(step_s).any():
        return smooth(values)
    steps = np.maximum(1, np.rint(step_s / find_period_s(step_s))).astype(np.int64)
    ticks = np.concatenate([[0], np.cumsum(steps)])
    even = np.interp(np.arange(ticks[-1] + 1), ticks, values)
    smoothed: Array = smooth(even)[ticks]
    return smoothed
