"""Fewer points for the same picture: extremes stay, and gaps stay gaps.

A line keeps the lowest and the highest point of every column of pixels. A cloud of points keeps
one point of every cell that it visits. All lengths are in the units of the drawing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


def find_unbroken(x: Floats, y: Floats) -> list[slice]:
    """Return the longest stretches in which both arrays, shape (n,), are finite."""
    finite = np.concatenate(([False], np.isfinite(x) & np.isfinite(y), [False]))
    begins = np.flatnonzero(~finite[:-1] & finite[1:])
    ends = np.flatnonzero(finite[:-1] & ~finite[1:])
    return [slice(int(b), int(e)) for b, e in zip(begins, ends, strict=True)]


def keep_extremes(x: Floats, y: Floats, column: float) -> Indices:
    """Return, in order, the points that draw the line through (x, y); x must not fall.

    Input: finite numbers of shape (n,). The lowest and highest point of each column stay, and the
    first and last point: at most two indices a column, and two more.
    """
    count = len(x)
    columns = np.floor(x / column)
    starts = np.flatnonzero(np.concatenate(([True], columns[1:] != columns[:-1])))
    if count <= 2 * len(starts) + 2:
        return np.arange(count)
    # Sorted by column, then by height: each column begins with its lowest point.
    order = np.lexsort((y, columns))
    ends = np.concatenate((starts[1:], [count])) - 1
    return np.unique(np.concatenate(([0], order[starts], order[ends], [count - 1])))


MOST_POINTS = 100_000
"""A longer line is kept by the extremes of half as many columns, finer than any screen."""


def thin_line(x: Floats, *ys: Floats) -> Indices:
    """Return the points that keep the extremes and the gaps of long lines, shape (n,), over x.

    A line with few points keeps all. x must not fall.
    """
    if len(x) <= MOST_POINTS or not np.isfinite(x).all():
        return np.arange(len(x))
    column = 2.0 * (x[-1] - x[0]) / MOST_POINTS
    kept = [np.zeros(1, np.intp)]
    for y in ys:
        gap = ~np.isfinite(y)
        if not gap.all():
            whole = np.interp(x, x[~gap], y[~gap]) if gap.any() else y
            kept.append(keep_extremes(x - x[0], whole, column))
            kept.append(np.flatnonzero(gap[1:] & ~gap[:-1]) + 1)
    return np.unique(np.concatenate(kept))


def thin_cloud(x: Floats, y: Floats, cell: float) -> Indices:
    """Return one point of every cell that a cloud of points visits, and the extremes of x and y."""
    if not len(x):
        return np.zeros(0, np.intp)
    cells = np.floor(x / cell) + 1j * np.floor(y / cell)
    _, first = np.unique(cells, return_index=True)
    outermost = (x.argmin(), x.argmax(), y.argmin(), y.argmax())
    return np.unique(np.concatenate((first, outermost)))


_GAP_STEPS = 20.0
"""A step in time that is so many times the usual one is a gap: nothing was measured there."""
_FEWEST_STEPS = 8


def break_at_gaps(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return a line over time, arrays of shape (n,), with a NaN in y where a gap in x begins.

    A line with few points has no usual step, and stays as it is.
    """
    steps = np.diff(x)
    if len(steps) < _FEWEST_STEPS or x.shape != y.shape:
        return x, y
    gaps = np.flatnonzero(steps > _GAP_STEPS * np.median(steps))
    between = 0.5 * (x[gaps] + x[gaps + 1])
    return np.insert(x, gaps + 1, between), np.insert(y, gaps + 1, np.nan)
