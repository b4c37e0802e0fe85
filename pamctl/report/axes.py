"""The axes of a plot: their ends and numbers, and how few points show the same line on them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.log.row_problems import find_runs

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
_MARGIN = 0.04
"""Free share of the range on either side of the data."""


@dataclass(frozen=True)
class PlotAxis:
    """An axis: `PlotAxis("pressure", "kPa")`; `low` and `high` fix its ends."""

    label: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    log: bool = False
    tight: bool = False
    """End at the data, without a margin; right for time."""

    @property
    def title(self) -> str:
        """Label and unit."""
        return ", ".join(part for part in (self.label, self.unit) if part)


class AxisTick(NamedTuple):
    """A round number beside an axis; `place` runs from 0 to 1."""

    place: float
    text: str
    spare: bool
    """True for every second number, never for zero: a narrow axis may omit it."""


@dataclass(frozen=True)
class Scale:
    """An axis with both ends known, `low < high`; both positive on a log axis."""

    low: float
    high: float
    log: bool = False

    def places(self, values: Floats) -> Floats:
        """Return the places of values: 0 at `low`, 1 at `high`, NaN where a value has no place."""
        with np.errstate(all="ignore"):
            if self.log:
                shown = np.where(values > 0.0, values, np.nan)
                places = np.log(shown / self.low) / math.log(self.high / self.low)
            else:
                places = (values - self.low) / (self.high - self.low)
        return np.where(np.isfinite(places), places, np.nan)

    def place(self, value: float) -> float:
        """Return the place of one value."""
        return float(self.places(np.array([value], dtype=np.float64))[0])

    def ticks(self, about: int = 6) -> list[AxisTick]:
        """Return round numbers within the axis, at most 1.5 times `about` of them."""
        decades = self._list_decades(about) if self.log else []
        if len(decades) > 1:
            return [
                AxisTick(self.place(value), format_tick(value, 0.0, value), index % 2 == 1)
                for index, value in enumerate(decades)
            ]
        step = choose_step((self.high - self.low) / about)
        if math.floor(self.high / step) == math.ceil(self.low / step):
            step = choose_step(step / 2.5)  # one number alone does not say the scale
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        largest = step * max(abs(first), abs(last), 1)
        return [
            AxisTick(
                self.place(index * step), format_tick(index * step, step, largest), index % 2 == 1
            )
            for index in range(first, last + 1)
        ]

    def _list_decades(self, about: int) -> list[float]:
        first, last = math.ceil(math.log10(self.low) - 1e-9), math.log10(self.high) + 1e-9
        every = max(1, math.ceil((last - first) / about))
        return [10.0**power for power in range(first, math.floor(last) + 1, every)]


def fit_scale(axis: PlotAxis, data: Iterable[Floats]) -> Scale:
    """Return a scale that shows all of the data, shape (n,) each; 0 to 1 if there are none."""
    low, high = math.inf, -math.inf
    for values in data:
        shown = values[np.isfinite(values) & ((values > 0.0) | (not axis.log))]
        if len(shown):
            low, high = min(low, float(shown.min())), max(high, float(shown.max()))
    if low > high:
        low, high = (1.0, 10.0) if axis.log else (0.0, 1.0)
    else:
        low, high = _widen(low, high, log=axis.log, tight=axis.tight)
    low = low if axis.low is None else axis.low
    high = high if axis.high is None else axis.high
    if not low < high:
        low, high = _widen(low, low, log=axis.log, tight=True)
    return Scale(low, high, axis.log)


def _widen(low: float, high: float, *, log: bool, tight: bool) -> tuple[float, float]:
    if log:
        factor = 1.0 if tight and high > low else max(1.25, (high / low) ** _MARGIN)
        return low / factor, high * factor
    smallest = 1e-9 * max(abs(low), abs(high), 1e-300)
    if high - low <= smallest:
        half = abs(low) * 0.05 or 1.0
        return low - half, high + half
    margin = 0.0 if tight else _MARGIN * (high - low)
    return low - margin, high + margin


def choose_step(rough: float) -> float:
    """Return 1, 2 or 5 times a power of ten, the smallest that is at least `rough`."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(power * digit for digit in (1.0, 2.0, 5.0, 10.0) if power * digit >= rough * 0.999)


def format_tick(value: float, step: float, largest: float) -> str:
    """Write a tick with enough digits to tell it from its neighbours; step 0 means a log axis."""
    if step == 0.0:
        text = f"{value:g}" if 1e-3 <= value < 1e5 else f"{value:.0e}".replace("e-0", "e-")
        return text.replace("e+0", "e").replace("-", "\N{MINUS SIGN}")
    if largest >= 1e6 or largest < 1e-3:
        digits = max(0, math.floor(math.log10(largest)) - math.floor(math.log10(step) + 1e-9))
        text = "0" if value == 0.0 else f"{value:.{digits}e}"
        text = text.replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")
    else:
        text = f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def find_unbroken(x: Floats, y: Floats) -> list[slice]:
    """Return the longest stretches in which both arrays, shape (n,), are finite."""
    return [slice(*run) for run in find_runs(np.isfinite(x) & np.isfinite(y)).tolist()]


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
    across, up = (np.floor(values / cell).astype(np.int64) for values in (x, y))
    _, first = np.unique(across * (1 << 32) + up, return_index=True)
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
