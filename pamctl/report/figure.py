"""A figure's data: lines, bands and points on the axes of `axes.py`.

    plot = Plot("Displacement", PlotAxis("time", "s", tight=True), PlotAxis("position", "mm"))
    plot.line(t_s, reference_mm, "reference", colour=MUTED)
    plot.line(t_s, position_mm, "measured")
    report.add(Figure([plot], caption="..."))          # pamctl.report.report

Colours are names; the page's style defines them for light and dark screens. `picture.py` draws a
plot without script, `uplot/plots.js` with one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pamctl.report.axes import (
    AxisTick,
    Floats,
    PlotAxis,
    Scale,
    break_at_gaps,
    fit_scale,
    thin_line,
)

Item = TypeVar("Item")

COLOURS = 7
"""The number of colours; further ones begin again with the first."""
MUTED = -1
"""The colour of data for comparison: a reference, a limit."""
FRAME_WIDTH = 7200
PIXEL = 10.0
"""Width of a drawn frame, and a pixel, in tenths of a pixel."""
_FEW_POINTS = 200


class PlotMark(NamedTuple):
    """Data in a plot; `kind` is `line`, `step`, `points` or `band`."""

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

    def points(self, x: ArrayLike, y: ArrayLike, label: str = "", *, colour: int = 0) -> Plot:
        """Draw points: few ones large, a cloud small."""
        across, up = self._pair(x, y)
        few = " few" if len(across) <= _FEW_POINTS else ""
        return self._put("points", across, (up,), label, f"p{few} {css_of(colour)}")

    def band(
        self,
        x: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        label: str = "",
        *,
        colour: int = 0,
        solid: bool = False,
    ) -> Plot:
        """Fill the area between two lines; `low` and `high` may also be numbers."""
        across = np.asarray(x, np.float64)
        ys = [np.broadcast_to(np.asarray(y, np.float64), across.shape) for y in (low, high)]
        kept = thin_line(across, *ys)
        lower, upper = (y[kept] for y in ys)
        css = f"b{' solid' if solid else ''} {css_of(colour)}"
        return self._put("band", across[kept], (lower, upper), label, css)

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
        """Whether a script can draw it from its data, which it seeks by x: x must not fall."""
        rises = all((np.diff(mark.x) >= 0.0).all() for mark in self.marks)
        return rises and any(len(mark.x) for mark in self.marks if mark.kind != "band")

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
