"""A figure's data: axes, lines, bands, points, bars; and how few points show the same picture.

    plot = Plot("Displacement", PlotAxis("time", "s", tight=True), PlotAxis("position", "mm"))
    plot.line(t_s, reference_mm, "reference", colour=MUTED)
    plot.line(t_s, position_mm, "measured")
    report.add(Figure([plot], caption="..."))          # pamctl.report.report

Colours are names; the page's style defines them for light and dark screens. `picture.py` draws a
plot without script, `uplot/plots.js` with one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Item = TypeVar("Item")

COLOURS = 7
"""The number of colours; further ones begin again with the first."""
MUTED = -1
"""The colour of data for comparison: a reference, a limit."""
FRAME_WIDTH = 7200
PIXEL = 10.0
"""Width of a drawn frame, and a pixel, in tenths of a pixel."""
_FEW_POINTS = 200
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


class PlotMark(NamedTuple):
    """Data in a plot; `kind` is `line`, `step`, `points`, `band`, `bars` or `density`."""

    kind: str
    x: Floats
    ys: tuple[Floats, ...]
    label: str
    css: str


class StraightLine(NamedTuple):
    """A line across the whole plot: at a place of the x axis, or at a height of the y axis."""

    axis: str
    value: float
    label: str
    css: str


class Plot:
    """One pair of axes. Data are array-likes of shape (n,) in the unit of their axis.

    `colour` is an index into the Okabe-Ito colours, or `MUTED`. Points that are not finite, or not
    positive on a log axis, are left out; a line breaks there.
    """

    def __init__(self, title: str, x: PlotAxis, y: PlotAxis, *, height_px: int = 180) -> None:
        self.title, self.x, self.y = title, x, y
        self.height_px = height_px
        self.names_x = True
        """False leaves the name of the x axis to the plot below."""
        self.marks: list[PlotMark] = []
        self.straight_lines: list[StraightLine] = []
        self._x_scale: Scale | None = None
        self._y_scale: Scale | None = None

    def line(
        self,
        x: ArrayLike,
        y: ArrayLike,
        label: str = "",
        *,
        colour: int = 0,
        step: bool = False,
        thick: bool = False,
    ) -> Plot:
        """Draw a line; x must not fall. With `step` each value holds until the next.

        Over time a line breaks where there are no data.
        """
        across, up = self._pair(x, y)
        if self.x.unit == "s":
            across, up = break_at_gaps(across, up)
        kept = thin_line(across, up)  # an hour of ticks stays in memory no longer than needed
        css = f"l {css_of(colour)}{' thick' if thick else ''}"
        return self._put("step" if step else "line", across[kept], (up[kept],), label, css)

    def density(self, x: ArrayLike, y: ArrayLike, *, colour: int = 0) -> Plot:
        """Shade the plane by how often (x, y) was there: a phase portrait of any length."""
        across, up = self._pair(x, y)
        return self._put("density", across, (up,), "", f"d {css_of(colour)}")

    def points(self, x: ArrayLike, y: ArrayLike, label: str = "", *, colour: int = 0) -> Plot:
        """Draw points: few ones large, a cloud small."""
        across, up = self._pair(x, y)
        few = " few" if len(across) <= _FEW_POINTS else ""
        return self._put("points", across, (up,), label, f"p{few} {css_of(colour)}")

    def band(
        self, x: ArrayLike, low: ArrayLike, high: ArrayLike, label: str = "", *, colour: int = 0
    ) -> Plot:
        """Fill the area between two lines; `low` and `high` may also be numbers."""
        across = np.asarray(x, np.float64)
        ys = [np.broadcast_to(np.asarray(y, np.float64), across.shape) for y in (low, high)]
        kept = thin_line(across, *ys)
        lower, upper = (y[kept] for y in ys)
        return self._put("band", across[kept], (lower, upper), label, f"b {css_of(colour)}")

    def bars(
        self, edges: ArrayLike, counts: ArrayLike, label: str = "", *, colour: int = 0
    ) -> Plot:
        """Draw a histogram: n counts between n + 1 rising edges."""
        sides, heights = np.asarray(edges, np.float64), np.asarray(counts, np.float64)
        if len(sides) != len(heights) + 1:
            raise ValueError(f"{self.title}: a histogram needs one edge more than counts")
        return self._put("bars", sides, (heights,), label, f"b solid {css_of(colour)}")

    def level(self, y: float, label: str = "", *, colour: int = MUTED) -> Plot:
        """Mark a height with a horizontal line; the axis does not grow for it."""
        self.straight_lines.append(StraightLine("y", y, label, css_of(colour)))
        return self

    def place(self, x: float, label: str = "", *, colour: int = MUTED) -> Plot:
        """Mark a place with a vertical line; the axis does not grow for it."""
        self.straight_lines.append(StraightLine("x", x, label, css_of(colour)))
        return self

    @property
    def can_be_zoomed(self) -> bool:
        """Whether a script can draw it from its data: it has lines, points and bands only."""
        drawn = all(mark.kind not in ("bars", "density") for mark in self.marks)
        return drawn and any(len(mark.x) for mark in self.marks)

    @property
    def has_data(self) -> bool:
        """Whether any point of it is a number."""
        return any(
            np.isfinite(mark.x).any() and np.isfinite(y).any()
            for mark in self.marks
            for y in mark.ys
        )

    @property
    def scales(self) -> tuple[Scale, Scale]:
        """The scales of x and y."""
        return (
            self._x_scale or fit_scale(self.x, [mark.x for mark in self.marks]),
            self._y_scale or fit_scale(self.y, [y for mark in self.marks for y in mark.ys]),
        )

    @property
    def y_ticks(self) -> list[AxisTick]:
        """The numbers beside the y axis."""
        return self.scales[1].ticks(max(4, self.height_px // 32))

    @property
    def longest_number(self) -> int:
        """Letters of the longest number beside the y axis."""
        return max((len(tick.text) for tick in self.y_ticks), default=0)

    def hides_lines(self) -> bool:
        """Return whether half of one of its coloured lines lies below the later ones."""
        lines = [m for m in self.marks if m.css.startswith("l") and " cm" not in m.css]
        drawn = [_find_ink(*self.scales, self.height_px * PIXEL, m.x, m.ys[0]) for m in lines]
        for place, (low, high) in enumerate(drawn):
            ink = np.nansum(high - low)
            for above, below in drawn[place + 1 :]:
                covered = np.minimum(high, below) - np.maximum(low, above)
                if ink and np.nansum(covered.clip(min=0.0)) > 0.5 * ink:
                    return True
        return False

    def _pair(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        across, up = np.asarray(x, np.float64), np.asarray(y, np.float64)
        if across.shape != up.shape or across.ndim != 1:
            raise ValueError(f"{self.title}: x has shape {across.shape}, y {up.shape}")
        return across, up

    def _put(self, kind: str, x: Floats, ys: tuple[Floats, ...], label: str, css: str) -> Plot:
        self.marks.append(PlotMark(kind, x, ys, label, css))
        return self


class Levels:
    """A few numbers as named bars from zero, such as before and after, in one unit.

    levels = Levels("Displacement", "µm")
    levels.bar("recalibrated", 1310.0, colour=1)
    levels.bar("with a rival", 5.2, ends=(4.0, 6.4))      # an interval is a line across the bar
    levels.mark(0.9)                                      # the noise of the sensor
    """

    def __init__(self, title: str, unit: str) -> None:
        self.title, self.unit = title, unit
        self.bars: list[tuple[str, float, int, tuple[float, float] | None]] = []
        """Label, value, colour, and the ends of its interval."""
        self.marked: float | None = None

    def bar(
        self,
        label: str,
        value: float,
        *,
        colour: int = 0,
        ends: tuple[float, float] | None = None,
    ) -> Levels:
        """Add a bar below the others; `ends` are those of its interval."""
        self.bars.append((label, value, colour, ends))
        return self

    def mark(self, value: float) -> Levels:
        """Draw a line at a value across all bars; the caption explains it."""
        self.marked = value
        return self


def share_axis(plots: Sequence[Plot], axis: str) -> Sequence[Plot]:
    """Give plots one `x` or `y` axis for the data of all, with the settings of the first's."""
    if plots:
        marks = [mark for plot in plots for mark in plot.marks]
        data = [m.x for m in marks] if axis == "x" else [y for m in marks for y in m.ys]
        scale = fit_scale(getattr(plots[0], axis), data)
        for plot in plots:
            setattr(plot, f"_{axis}_scale", scale)
            if axis == "x":
                plot.names_x = plot is plots[-1]
    return plots


def plot_apart(draw: Callable[[Sequence[Item]], Plot | None], of: Sequence[Item]) -> list[Plot]:
    """Return one plot of all items, or one for each where their lines would hide each other.

    Plots of single items have the same y axis. `draw` returns None if it has nothing to show.
    """
    together = draw(of)
    if together is None:
        return []
    if len(of) == 1 or not together.hides_lines():
        return [together]
    alone = (draw([one]) for one in of)
    return [*share_axis([plot for plot in alone if plot is not None], "y")]


def css_of(colour: int) -> str:
    """Return the style class of a colour."""
    return "cm" if colour == MUTED else f"c{colour % COLOURS}"


def _find_ink(
    x_scale: Scale, y_scale: Scale, height: float, x: Floats, y: Floats
) -> tuple[Floats, Floats]:
    """Return the highest and the lowest place of a line in each column; NaN where it has none."""
    columns = FRAME_WIDTH // round(PIXEL)
    across, down = place_across(x_scale, x), place_down(y_scale, y, height)
    shown = np.isfinite(across) & np.isfinite(down)
    across, down = across[shown], down[shown]
    if 0 < len(across) < 2 * columns:
        finer = np.linspace(across[0], across[-1], 2 * columns)
        across, down = finer, np.interp(finer, across, down)
    at = (across / PIXEL).astype(int).clip(0, columns - 1)
    low, high = np.full(columns, np.inf), np.full(columns, -np.inf)
    np.minimum.at(low, at, down)
    np.maximum.at(high, at, down)
    known = high >= low
    stroke = 0.65 * PIXEL
    return np.where(known, low - stroke, np.nan), np.where(known, high + stroke, np.nan)


def place_across(scale: Scale, values: Floats) -> Floats:
    """Return horizontal places in a frame; values far outside are drawn just outside."""
    return np.clip(scale.places(values), -1.0, 2.0) * FRAME_WIDTH


def place_down(scale: Scale, values: Floats, height: float) -> Floats:
    """Return vertical places in a frame of a height, from the top."""
    return (1.0 - np.clip(scale.places(values), -1.0, 2.0)) * height
