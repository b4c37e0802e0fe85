"""Samples at which a record says nothing: frozen stretches; and what fills them.

Spikes and dropouts are found before (`diagnose.mend`), and come in a record's `counts`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.log.record_problems import find_sensor_step

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FROZEN = 20
"""Equal samples in a row of a channel whose noise is above its step."""


def find_resolution(row: Array) -> float:
    """Return the step with which a channel was digitised; a millionth of its span if none shows."""
    return find_sensor_step(row) or max(1e-6 * float(np.ptp(row)), 1e-12)


def find_frozen(row: Array) -> Mask:
    """Return the samples of runs of equal values, where the channel's noise forbids them."""
    changes = np.diff(row) != 0.0
    frozen = np.zeros(len(row), dtype=bool)
    if changes.mean() < 0.5:  # a resting encoder repeats itself
        return frozen
    edges = np.flatnonzero(np.concatenate([[True], changes, [True]]))
    for begin, end in pairwise(edges):
        if end - begin >= FROZEN:
            frozen[begin:end] = True
    return frozen


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
