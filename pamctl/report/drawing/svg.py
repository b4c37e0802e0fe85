"""A plot: two axes, the data between them, and a legend.

    plot = SvgPlot("Displacement", PlotAxis("time", "s", tight=True), PlotAxis("position", "mm"))
    plot.line(t_s, reference_mm, "reference", colour=MUTED)
    plot.line(t_s, position_mm, "measured")
    page.figure(plot, caption="...")          # pamctl.report.html_page

The data's frame is stretched to the width of screen or paper, while strokes, numbers and words
keep their size: the same figure is readable on a phone and in print. Colours are names; the
page's style defines them for light and dark screens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from html import escape
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pamctl.report.drawing import marks
from pamctl.report.drawing.decimate import break_at_gaps, thin_line
from pamctl.report.drawing.marks import FRAME_WIDTH, HEAT, PIXEL, Frame, HeatRange, PlotMark
from pamctl.report.drawing.scale import PlotAxis, Scale, fit_scale

__all__ = ["MUTED", "PlotAxis", "SvgPlot", "css_of", "plot_apart", "share_x_axis", "share_y_axis"]

Floats = NDArray[np.float64]
Item = TypeVar("Item")
Draw = Callable[[Frame, Floats, Floats, str], str]

COLOURS = 7
"""The number of colours; further ones begin again with the first."""
MUTED = -1
"""The colour of data for comparison: a reference, a limit."""

_FEW_POINTS = 200
_SWATCHES = {"b": "M1 1h20v8h-20z", "l": "M1 5h20", "p": "M11 5h0"}
"""What the legend shows of bands and bars, lines, and points."""
_ROOM_ABOVE, _ROOM_BELOW, _ROOM_BELOW_UNNAMED = 8, 42, 24


class StraightLine(NamedTuple):
    """A line across the whole plot: at a place of the x axis, or at a height of the y axis."""

    axis: str
    value: float
    label: str
    css: str


class SvgPlot:
    """One pair of axes. Data are array-likes of shape (n,) in the unit of their axis.

    `colour` is an index into the Okabe-Ito colours, or `MUTED`. Points that are not finite, or not
    positive on a log axis, are left out; a line breaks there.
    """

    def __init__(self, title: str, x: PlotAxis, y: PlotAxis, *, height_px: int = 180) -> None:
        self.title = title
        self.x, self.y = x, y
        self.height_px = height_px
        self._marks: list[PlotMark] = []
        self._lines: list[StraightLine] = []
        self._x_scale: Scale | None = None
        self._y_scale: Scale | None = None
        self._shaded: int | None = None
        self.names_x = True
        self._heat: tuple[str, HeatRange] | None = None

    def line(
        self,
        x: ArrayLike,
        y: ArrayLike,
        label: str = "",
        *,
        colour: int = 0,
        step: bool = False,
        thick: bool = False,
    ) -> SvgPlot:
        """Draw a line; x must not fall. With `step` each value holds until the next.

        Over time a line breaks where there are no data.
        """
        if self.x.unit == "s":
            x, y = break_at_gaps(_to_floats(x), _to_floats(y))
        css = f"l {css_of(colour)}{' thick' if thick else ''}"
        kind = "step" if step else "line"
        return self._add(x, y, label, css, partial(marks.draw_line, step=step), kind)

    def density(self, x: ArrayLike, y: ArrayLike, *, colour: int = 0) -> SvgPlot:
        """Shade the plane by how often (x, y) was there: a phase portrait of any length."""
        self._shaded = colour
        return self._add(x, y, "", f"d {css_of(colour)}", marks.draw_density)

    def points(self, x: ArrayLike, y: ArrayLike, label: str = "", *, colour: int = 0) -> SvgPlot:
        """Draw points: few ones large, a cloud small."""
        few = " few" if len(_to_floats(x)) <= _FEW_POINTS else ""
        return self._add(x, y, label, f"p{few} {css_of(colour)}", marks.draw_points, "points")

    def band(
        self, x: ArrayLike, low: ArrayLike, high: ArrayLike, label: str = "", *, colour: int = 0
    ) -> SvgPlot:
        """Fill the area between two lines; `low` and `high` may also be numbers."""
        across = _to_floats(x)
        lower = np.broadcast_to(_to_floats(low), across.shape)
        upper = np.broadcast_to(_to_floats(high), across.shape)
        kept = thin_line(across, lower, upper)
        across, lower, upper = across[kept], lower[kept], upper[kept]
        css = f"b {css_of(colour)}"

        def draw(frame: Frame) -> str:
            return marks.draw_band(frame, across, lower, upper, css)

        return self._put(PlotMark([across], [lower, upper], label, css, draw, "band"))

    def bars(
        self, edges: ArrayLike, counts: ArrayLike, label: str = "", *, colour: int = 0
    ) -> SvgPlot:
        """Draw a histogram: n counts between n + 1 rising edges."""
        sides, heights, css = _to_floats(edges), _to_floats(counts), f"b solid {css_of(colour)}"
        if len(sides) != len(heights) + 1:
            raise ValueError(f"{self.title}: a histogram needs one edge more than counts")

        def draw(frame: Frame) -> str:
            return marks.draw_bars(frame, sides, heights, css)

        return self._put(PlotMark([sides], [heights], label, css, draw))

    def heat(
        self,
        x_edges: ArrayLike,
        y_edges: ArrayLike,
        values: ArrayLike,
        label: str,
        *,
        low: float | None = None,
        high: float | None = None,
    ) -> SvgPlot:
        """Draw a map: `values` of shape (m, n) between m + 1 y edges and n + 1 x edges."""
        across, up, grid = _to_floats(x_edges), _to_floats(y_edges), _to_floats(values)
        if grid.shape != (len(up) - 1, len(across) - 1):
            raise ValueError(
                f"{self.title}: a map needs one edge more than cells in both directions"
            )
        finite = grid[np.isfinite(grid)]
        shown = HeatRange(
            low if low is not None else float(min(finite, default=0.0)),
            high if high is not None else float(max(finite, default=1.0)),
        )
        self._heat = label, shown

        def draw(frame: Frame) -> str:
            return marks.draw_cells(frame, across, up, grid, shown)

        return self._put(PlotMark([across], [up], "", "", draw))

    def level(self, y: float, label: str = "", *, colour: int = MUTED) -> SvgPlot:
        """Mark a height with a horizontal line; the axis does not grow for it."""
        self._lines.append(StraightLine("y", y, label, css_of(colour)))
        return self

    def place(self, x: float, label: str = "", *, colour: int = MUTED) -> SvgPlot:
        """Mark a place with a vertical line; the axis does not grow for it."""
        self._lines.append(StraightLine("x", x, label, css_of(colour)))
        return self

    @property
    def marks(self) -> Sequence[PlotMark]:
        """The data, in the order in which they are drawn."""
        return self._marks

    @property
    def straight_lines(self) -> Sequence[StraightLine]:
        """The marked places and heights."""
        return self._lines

    @property
    def can_be_zoomed(self) -> bool:
        """Whether a script can draw it from its data: it has lines, points and bands only."""
        return any(len(values) for values in self.x_data) and all(m.kind for m in self._marks)

    @property
    def x_data(self) -> list[Floats]:
        """All data that the x axis must show."""
        return [values for mark in self._marks for values in mark.xs]

    @property
    def y_data(self) -> list[Floats]:
        """All data that the y axis must show."""
        return [values for mark in self._marks for values in mark.ys]

    def share_x(self, scale: Scale, *, names_x: bool = True) -> None:
        """Use a common x scale, and leave its name to the plot below."""
        self._x_scale, self.names_x = scale, names_x

    def share_y(self, scale: Scale) -> None:
        """Use a common y scale."""
        self._y_scale = scale

    def hides_lines(self) -> bool:
        """Return whether one of its coloured lines can hardly be seen below the others."""
        coloured = [m for m in self._marks if m.css.startswith("l") and " cm" not in m.css]
        return len(coloured) > 1 and marks.hides_line(self.make_frame(), coloured)

    def make_frame(self) -> Frame:
        """Return the frame with both scales."""
        whole = self._heat is not None  # a map ends at the edges of its cells
        x = self._x_scale or fit_scale(replace(self.x, tight=self.x.tight or whole), self.x_data)
        y = self._y_scale or fit_scale(replace(self.y, tight=self.y.tight or whole), self.y_data)
        return Frame(x, y, self.height_px * PIXEL)

    def html(self) -> str:
        """Return the plot with its legend as escaped HTML, without its own style."""
        frame = self.make_frame()
        x, y, _ = frame
        name = escape(f"{self.title}: {self.y.title} over {self.x.title}")
        drawn = "".join(mark.draw(frame) for mark in self._marks)
        below = _ROOM_BELOW if self.names_x else _ROOM_BELOW_UNNAMED
        return (
            f'<div class="plot"><div class="ptitle">{escape(self.title)} '
            f'<span class="unit">{escape(self._y_name())}</span></div>{self._draw_legend()}'
            f'<div class="frame"><svg role="img" aria-label="{name}" width="100%" '
            f'height="{self.height_px + _ROOM_ABOVE + below}">'
            f"<title>{name}</title>"
            f'<svg y="{_ROOM_ABOVE}" width="100%" height="{self.height_px + below}" '
            f'class="open">{self._grid(x, y)}'
            f'<svg class="data" width="100%" height="{self.height_px}" '
            f'viewBox="0 0 {FRAME_WIDTH} {self.height_px * PIXEL:.0f}" '
            f'preserveAspectRatio="none">{drawn}{self._draw_levels(frame)}</svg>'
            f"{self._draw_level_texts(frame)}{self._draw_missing_data()}</svg></svg></div></div>"
        )

    def _y_name(self) -> str:
        """Return the parts of the axis label that the title does not state."""
        title, label = self.title.casefold(), self.y.label.casefold()
        same = title == label or title.startswith(f"{label},")
        return self.y.unit if same else self.y.title

    def _grid(self, x: Scale, y: Scale) -> str:
        """Return grid lines and numbers; a narrow x axis may omit every second number."""
        bottom = self.height_px
        parts = [f'<rect class="paper" width="100%" height="{bottom}"/>']
        for place, text, _ in y.ticks(max(4, bottom // 32)):
            at = (1.0 - place) * bottom
            parts.append(f'<line class="grid" x2="100%" y1="{at:.1f}" y2="{at:.1f}"/>')
            parts.append(f'<text class="yt" x="-6" y="{at + 4:.1f}">{text}</text>')
        for place, text, spare in x.ticks(8):
            at_share = f"{place * 100:.2f}%"
            parts.append(f'<line class="grid" x1="{at_share}" x2="{at_share}" y2="{bottom}"/>')
            css = "xt spare" if spare else "xt"
            parts.append(f'<text class="{css}" x="{at_share}" y="{bottom + 16}">{text}</text>')
        if self.names_x:
            title = escape(self.x.title)
            parts.append(f'<text class="xl" x="100%" y="{bottom + 34}">{title}</text>')
        return "".join(parts)

    def _draw_levels(self, frame: Frame) -> str:
        return "".join(
            f'<path class="l mark {css}" d="{_draw_straight(frame, axis, value)}"/>'
            for axis, value, _, css in self._lines
            if _is_visible(frame, axis, value)
        )

    def _draw_level_texts(self, frame: Frame) -> str:
        texts = []
        rows: list[float] = []
        for axis, value, label, _ in sorted(self._lines):
            if not label or not _is_visible(frame, axis, value):
                continue
            if axis == "y":
                down = (1.0 - frame.y.place(value)) * self.height_px
                down = down - 4 if down > 16 else down + 13
                texts.append(f'<text class="note end" x="99.5%" y="{down:.1f}">')
            else:
                place = frame.x.place(value)
                side = " end" if place > 0.7 else ""
                row = _find_free_row(rows, place, len(label), at_end=bool(side))
                nudge = -4 if side else 4
                # On a narrow screen the texts of the first row alone have room.
                css = f"note{side}{' spare' if row else ''}"
                texts.append(
                    f'<text class="{css}" x="{place * 100:.2f}%" dx="{nudge}" y="{12 + 13 * row}">'
                )
            texts.append(f"{escape(label)}</text>")
        return "".join(texts)

    def _draw_missing_data(self) -> str:
        shown = any(
            np.isfinite(x).any() and np.isfinite(y).any()
            for mark in self._marks
            for x, y in zip(mark.xs, mark.ys, strict=False)
        )
        if shown:
            return ""
        middle = self.height_px // 2
        return f'<text class="note mid" x="50%" y="{middle}">nothing was measured</text>'

    def _draw_legend(self) -> str:
        entries = [
            f'<li><svg class="swatch" viewBox="0 0 22 10"><path class="{mark.css}" '
            f'd="{_SWATCHES[mark.css[0]]}"/></svg>'
            f"{escape(mark.label)}</li>"
            for mark in self._marks
            if mark.label
        ]
        if self._shaded is not None:
            css = css_of(self._shaded)
            shades = "".join(
                f'<path class="d {css}" fill-opacity="{k / marks.DENSITIES}" '
                f'd="M{22 * k - 22} 0h22v10h-22z"/>'
                for k in range(1, marks.DENSITIES + 1)
            )
            entries.append(
                f'<li>seldom <svg class="shades" viewBox="0 0 110 10">{shades}</svg> often</li>'
            )
        if self._heat is not None:
            label, (low, high) = self._heat
            stops = ", ".join(f"rgb{stop}" for stop in HEAT)
            entries.append(
                f"<li>{escape(label)} {low:.4g} "
                f'<i class="heat" style="background:linear-gradient(90deg, {stops})"></i> '
                f"{high:.4g}</li>"
            )
        return f'<ul class="legend">{"".join(entries)}</ul>' if entries else ""

    def _add(
        self, x: ArrayLike, y: ArrayLike, label: str, css: str, draw: Draw, kind: str = ""
    ) -> SvgPlot:
        across, up = _to_floats(x), _to_floats(y)
        if across.shape != up.shape or across.ndim != 1:
            raise ValueError(f"{self.title}: x has shape {across.shape}, y {up.shape}")
        if kind in ("line", "step"):  # an hour of ticks stays in memory no longer than needed
            kept = thin_line(across, up)
            across, up = across[kept], up[kept]
        return self._put(
            PlotMark([across], [up], label, css, lambda f: draw(f, across, up, css), kind)
        )

    def _put(self, mark: PlotMark) -> SvgPlot:
        self._marks.append(mark)
        return self


def share_x_axis(plots: Sequence[SvgPlot]) -> Sequence[SvgPlot]:
    """Give plots one x axis for the data of all, with the settings of the first one's axis."""
    if plots:
        scale = fit_scale(plots[0].x, [values for plot in plots for values in plot.x_data])
        for plot in plots:
            plot.share_x(scale, names_x=plot is plots[-1])
    return plots


def share_y_axis(plots: Sequence[SvgPlot]) -> Sequence[SvgPlot]:
    """Give plots one y axis for the data of all, with the settings of the first one's axis."""
    if plots:
        scale = fit_scale(plots[0].y, [values for plot in plots for values in plot.y_data])
        for plot in plots:
            plot.share_y(scale)
    return plots


def plot_apart(
    draw: Callable[[Sequence[Item]], SvgPlot | None], of: Sequence[Item]
) -> list[SvgPlot]:
    """Return one plot of all items, or one for each where their lines would hide each other.

    Plots of single items have the same y axis. `draw` returns None if it has nothing to show.
    """
    together = draw(of)
    if together is None:
        return []
    if len(of) == 1 or not together.hides_lines():
        return [together]
    alone = (draw([one]) for one in of)
    return [*share_y_axis([plot for plot in alone if plot is not None])]


def css_of(colour: int) -> str:
    """Return the style class of a colour."""
    return "cm" if colour == MUTED else f"c{colour % COLOURS}"


def _to_floats(values: ArrayLike) -> Floats:
    return np.asarray(values, dtype=np.float64)


def _is_visible(frame: Frame, axis: str, value: float) -> bool:
    place = (frame.x if axis == "x" else frame.y).place(value)
    return 0.0 <= place <= 1.0


_USUAL_PX, _LETTER_PX = 700.0, 6.5
_MOST_ROWS = 4


def _find_free_row(rows: list[float], place: float, letters: int, *, at_end: bool) -> int:
    """Return the first row of texts with room at a place from 0 to 1, and take it.

    `rows` holds the end of the last text of each row; texts come from left to right.
    """
    width = (letters * _LETTER_PX + 12.0) / _USUAL_PX
    begin = place - width if at_end else place
    row = next((k for k, end in enumerate(rows) if end <= begin), len(rows) % _MOST_ROWS)
    rows[row : row + 1] = [begin + width]
    return row


def _draw_straight(frame: Frame, axis: str, value: float) -> str:
    if axis == "x":
        return f"M{frame.x.place(value) * FRAME_WIDTH:.0f} 0V{frame.height:.0f}"
    return f"M0 {(1.0 - frame.y.place(value)) * frame.height:.0f}H{FRAME_WIDTH}"
