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

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pamctl.report.drawing import marks
from pamctl.report.drawing.decimate import break_at_gaps
from pamctl.report.drawing.marks import FRAME_WIDTH, HEAT, PIXEL, Frame, HeatRange, PlotMark
from pamctl.report.drawing.scale import PlotAxis, Scale, fit_scale

__all__ = ["MUTED", "PlotAxis", "SvgPlot", "css_of", "share_x_axis"]

Floats = NDArray[np.float64]
Draw = Callable[[Frame, Floats, Floats, str], str]

COLOURS = 7
"""The number of colours; further ones begin again with the first."""
MUTED = -1
"""The colour of data for comparison: a reference, a limit."""

_ROOM_ABOVE, _ROOM_BELOW, _ROOM_BELOW_UNNAMED = 8, 42, 24


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
        self._lines: list[tuple[str, float, str, int]] = []
        self._x_scale: Scale | None = None
        self._names_x = True
        self._heat: tuple[str, HeatRange] | None = None

    def line(
        self,
        x: ArrayLike,
        y: ArrayLike,
        label: str = "",
        *,
        colour: int = 0,
        step: bool = False,
        dashed: bool = False,
        thick: bool = False,
    ) -> SvgPlot:
        """Draw a line; x must not fall. With `step` each value holds until the next.

        Over time a line breaks where there are no data.
        """
        if self.x.unit == "s":
            x, y = break_at_gaps(_to_floats(x), _to_floats(y))
        css = f"l {css_of(colour)}{' dash' if dashed else ''}{' thick' if thick else ''}"
        return self._add(x, y, label, css, partial(marks.draw_line, step=step))

    def curve(self, x: ArrayLike, y: ArrayLike, label: str = "", *, colour: int = 0) -> SvgPlot:
        """Draw a curve through the plane, in the order of its points: a phase portrait."""
        return self._add(x, y, label, f"l thin {css_of(colour)}", marks.draw_curve)

    def points(self, x: ArrayLike, y: ArrayLike, label: str = "", *, colour: int = 0) -> SvgPlot:
        """Draw a cloud of points."""
        return self._add(x, y, label, f"p {css_of(colour)}", marks.draw_points)

    def band(
        self, x: ArrayLike, low: ArrayLike, high: ArrayLike, label: str = "", *, colour: int = 0
    ) -> SvgPlot:
        """Fill the area between two lines; `low` and `high` may also be numbers."""
        across = _to_floats(x)
        lower = np.broadcast_to(_to_floats(low), across.shape)
        upper = np.broadcast_to(_to_floats(high), across.shape)
        css = f"b {css_of(colour)}"

        def draw(frame: Frame) -> str:
            return marks.draw_band(frame, across, lower, upper, css)

        return self._put(PlotMark([across], [lower, upper], label, css, draw))

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
        self._lines.append(("y", y, label, colour))
        return self

    def place(self, x: float, label: str = "", *, colour: int = MUTED) -> SvgPlot:
        """Mark a place with a vertical line; the axis does not grow for it."""
        self._lines.append(("x", x, label, colour))
        return self

    @property
    def x_data(self) -> list[Floats]:
        """All data that the x axis must show."""
        return [values for mark in self._marks for values in mark.xs]

    def share_x(self, scale: Scale, *, names_x: bool = True) -> None:
        """Use a common x scale, and leave its name to the plot below."""
        self._x_scale, self._names_x = scale, names_x

    def html(self) -> str:
        """Return the plot with its legend as escaped HTML, without its own style."""
        whole = self._heat is not None  # a map ends at the edges of its cells
        x = self._x_scale or fit_scale(replace(self.x, tight=self.x.tight or whole), self.x_data)
        y = fit_scale(
            replace(self.y, tight=self.y.tight or whole),
            [values for mark in self._marks for values in mark.ys],
        )
        frame = Frame(x, y, self.height_px * PIXEL)
        name = escape(f"{self.title}: {self.y.title} over {self.x.title}")
        drawn = "".join(mark.draw(frame) for mark in self._marks)
        below = _ROOM_BELOW if self._names_x else _ROOM_BELOW_UNNAMED
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
        same = self.title.casefold() == self.y.label.casefold()
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
        if self._names_x:
            title = escape(self.x.title)
            parts.append(f'<text class="xl" x="100%" y="{bottom + 34}">{title}</text>')
        return "".join(parts)

    def _draw_levels(self, frame: Frame) -> str:
        return "".join(
            f'<path class="l mark {css_of(colour)}" d="{_draw_straight(frame, axis, value)}"/>'
            for axis, value, _, colour in self._lines
            if _is_visible(frame, axis, value)
        )

    def _draw_level_texts(self, frame: Frame) -> str:
        texts = []
        for axis, value, label, _ in self._lines:
            if not label or not _is_visible(frame, axis, value):
                continue
            if axis == "y":
                down = (1.0 - frame.y.place(value)) * self.height_px
                down = down - 4 if down > 16 else down + 13
                texts.append(f'<text class="note end" x="99.5%" y="{down:.1f}">')
            else:
                place = frame.x.place(value)
                side = " end" if place > 0.7 else ""
                nudge = -4 if side else 4
                texts.append(
                    f'<text class="note{side}" x="{place * 100:.2f}%" dx="{nudge}" y="12">'
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
            f'd="{"M1 1h20v8h-20z" if mark.css.startswith("b") else "M1 5h20"}"/></svg>'
            f"{escape(mark.label)}</li>"
            for mark in self._marks
            if mark.label
        ]
        if self._heat is not None:
            label, (low, high) = self._heat
            stops = ", ".join(f"rgb{stop}" for stop in HEAT)
            entries.append(
                f"<li>{escape(label)} {low:.4g} "
                f'<i class="heat" style="background:linear-gradient(90deg, {stops})"></i> '
                f"{high:.4g}</li>"
            )
        return f'<ul class="legend">{"".join(entries)}</ul>' if entries else ""

    def _add(self, x: ArrayLike, y: ArrayLike, label: str, css: str, draw: Draw) -> SvgPlot:
        across, up = _to_floats(x), _to_floats(y)
        if across.shape != up.shape or across.ndim != 1:
            raise ValueError(f"{self.title}: x has shape {across.shape}, y {up.shape}")
        return self._put(PlotMark([across], [up], label, css, lambda f: draw(f, across, up, css)))

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


def css_of(colour: int) -> str:
    """Return the style class of a colour."""
    return "cm" if colour == MUTED else f"c{colour % COLOURS}"


def _to_floats(values: ArrayLike) -> Floats:
    return np.asarray(values, dtype=np.float64)


def _is_visible(frame: Frame, axis: str, value: float) -> bool:
    place = (frame.x if axis == "x" else frame.y).place(value)
    return 0.0 <= place <= 1.0


def _draw_straight(frame: Frame, axis: str, value: float) -> str:
    if axis == "x":
        return f"M{frame.x.place(value) * FRAME_WIDTH:.0f} 0V{frame.height:.0f}"
    return f"M0 {(1.0 - frame.y.place(value)) * frame.height:.0f}H{FRAME_WIDTH}"
