"""Time stamps that software scattered, while the samples themselves were taken regularly.

A card samples by its own clock, and a program reads the time when it fetches the sample. A signal
that moves then looks noisy on its stamps and smooth on a regular grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pamctl.diagnose.measured.record import Array, Record

LEAST_SCATTER = 0.02
"""Scatter of the stamps, in periods, below which it does not matter."""
LONGEST_STEP = 2.5
"""A step of more periods is a gap; the grid begins anew after it."""
FARTHEST = 4.0
"""Periods that a stamp may be from the grid; clocks that run apart have no common grid."""
MISSED = 1.6
"""A step of more periods misses a sample."""
SAMPLES, ORDER = 7, 3
"""Samples of a stretch, and order of the polynomial that a smooth signal follows over it."""
BETTER = 1.3
"""What the stamps leave over what the grid leaves, in squares."""
SURE = 4.0
"""By how many of its own standard errors the difference must be away from zero."""


def find_regular_times(records: Sequence[Record]) -> list[Array | None]:
    """Return for each record the times of a regular grid, or None where its stamps are to be used.

    The grid is used where it explains the signals better. One program stamped all records: if it
    does so in one, it is also used where a slow or noisy signal does not tell.
    """
    grids = [_find_grid(record) for record in records]
    verdicts = [
        {0}
        if grid_s is None
        else {_compare(r[c], r.t_s, grid_s) for c in r.channels if c != "valve_v"}
        for r, grid_s in zip(records, grids, strict=True)
    ]
    is_sure = any(1 in v and -1 not in v for v in verdicts)
    return [
        grid_s if is_sure and -1 not in v else None
        for grid_s, v in zip(grids, verdicts, strict=True)
    ]


def _find_grid(record: Record) -> Array | None:
    """Return the grid that a record's stamps scatter about; None where they do not."""
    grid_s = _fit_grid(record.t_s, record.period_s)
    if grid_s is None or float(np.std(record.t_s - grid_s)) < LEAST_SCATTER * record.period_s:
        return None
    return grid_s


def cut_even_stretches(record: Record) -> list[slice]:
    """Return the stretches without a missed sample."""
    cuts = np.flatnonzero(record.step_s > MISSED * record.period_s) + 1
    edges = [0, *cuts.tolist(), len(record)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _fit_grid(t_s: Array, period_s: float) -> Array | None:
    cuts = np.flatnonzero(np.diff(t_s) > LONGEST_STEP * period_s) + 1
    parts = []
    for part in np.split(t_s, cuts):
        index = np.arange(len(part), dtype=np.float64)
        if len(part) < 8 * SAMPLES:
            parts.append(part)
            continue
        line = np.polynomial.Polynomial.fit(index, part, 1)(index)
        if float(np.abs(part - line).max()) > FARTHEST * period_s:
            return None
        parts.append(line)
    grid_s = np.concatenate(parts)
    return grid_s if np.all(np.diff(grid_s) > 0.0) else None


def _compare(values: Array, t_s: Array, grid_s: Array) -> int:
    """Return 1 where the grid explains a channel better, -1 where the stamps do, otherwise 0."""
    by_stamps, by_grid = _leave(values, t_s), _leave(values, grid_s)
    difference = by_stamps - by_grid
    error = float(difference.std()) / np.sqrt(max(len(difference), 1))
    if abs(float(difference.mean())) < SURE * error:
        return 0
    stamps, grid = float(by_stamps.sum()), float(by_grid.sum())
    return int(stamps > BETTER * grid) - int(grid > BETTER * stamps)


def _leave(values: Array, t_s: Array) -> Array:
    """Return the squares that a polynomial leaves of each stretch, shape (stretches,)."""
    count = len(values) // SAMPLES
    shape = (count, SAMPLES)
    times, parts = (a[: count * SAMPLES].reshape(shape) for a in (t_s, values))
    middle = times.mean(axis=1, keepdims=True)
    scaled = (times - middle) / np.ptp(times, axis=1, keepdims=True)
    basis = np.linalg.qr(np.stack([scaled**n for n in range(ORDER + 1)], axis=2))[0]
    inside = np.einsum("kso,ks->ko", basis, parts)
    left = parts - np.einsum("kso,ko->ks", basis, inside)
    squares: Array = np.sum(left**2, axis=1)
    return squares
