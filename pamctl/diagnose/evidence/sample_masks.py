"""What stands in for samples at which a record says nothing."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.log.record_problems import find_sensor_step

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def find_resolution(row: Array) -> float:
    """Return the step with which a channel was digitised; a millionth of its span if none shows."""
    return find_sensor_step(row) or max(1e-6 * float(np.ptp(row)), 1e-12)


def fill_gone(row: Array, gone: Mask) -> Array:
    """Return a column whose missing samples lie on lines between their neighbours."""
    if not gone.any():
        return row
    if gone.all():
        return np.zeros_like(row)
    at = np.arange(len(row))
    return np.interp(at, at[~gone], row[~gone])


def find_neighbours(masked: Mask, ends: NDArray[np.int64]) -> tuple[Any, Any, Any, Array]:
    """Return the masked samples, their next unmasked ones on either side, and the right's share."""
    at = np.flatnonzero(masked)
    lefts, rights = np.zeros(len(at), dtype=int), np.zeros(len(at), dtype=int)
    for begin, end in pairwise(ends):
        seen = begin + np.flatnonzero(~masked[begin:end])
        mine = (at >= begin) & (at < end)
        if not mine.any():
            continue
        if not len(seen):
            lefts[mine] = rights[mine] = begin
            continue
        place = np.searchsorted(seen, at[mine])
        lefts[mine] = seen[np.maximum(place - 1, 0)]
        rights[mine] = seen[np.minimum(place, len(seen) - 1)]
    lefts = np.where(lefts > at, rights, lefts)
    rights = np.where(rights < at, lefts, rights)
    share = np.where(rights > lefts, (at - lefts) / np.maximum(rights - lefts, 1), 0.0)
    return at, lefts, rights, share
