"""A few numbers as named bars beside each other, such as before and after.

levels = Levels("Displacement", "µm")
levels.bar("recalibrated", 1310.0, colour=1)
levels.bar("with valve_deadband", 4.8)
levels.bar("with a rival", 5.2, ends=(4.0, 6.4))
levels.mark(0.9)                          # the noise of the sensor
page.grid(levels)                         # pamctl.report.html_page
"""

from __future__ import annotations

from html import escape
from typing import NamedTuple

from pamctl.report.drawing.svg import css_of

_WIDTH = 1000


class _Bar(NamedTuple):
    label: str
    value: float
    colour: int
    ends: tuple[float, float] | None


class Levels:
    """Bars from zero, in one unit and on one linear scale; an interval is a line across a bar."""

    def __init__(self, title: str, unit: str) -> None:
        self.title, self.unit = title, unit
        self._bars: list[_Bar] = []
        self._mark: float | None = None

    def bar(
        self,
        label: str,
        value: float,
        *,
        colour: int = 0,
        ends: tuple[float, float] | None = None,
    ) -> Levels:
        """Add a bar below the others; `ends` are those of its interval."""
        self._bars.append(_Bar(label, value, colour, ends))
        return self

    def mark(self, value: float) -> Levels:
        """Draw a line at a value across all bars; the caption explains it."""
        self._mark = value
        return self

    def html(self) -> str:
        """Return the bars as escaped HTML, without their own style."""
        return (
            f'<div class="plot"><div class="ptitle">{escape(self.title)}</div>'
            f'<div class="levels">{"".join(map(self._draw_row, self._bars))}</div></div>'
        )

    def _draw_row(self, bar: _Bar) -> str:
        text = f"{bar.value:.4g} {self.unit}"
        begin, end = sorted((self._place_of(0.0), self._place_of(bar.value)))
        end = max(end, begin + 3)  # a bar of zero length stays visible
        return (
            f'<span>{escape(bar.label)}</span><svg class="data" role="img" '
            f'aria-label="{escape(f"{bar.label}: {text}")}" '
            f'viewBox="0 0 {_WIDTH} 10" preserveAspectRatio="none">'
            f'<path class="b solid {css_of(bar.colour)}" d="M{begin} 0H{end}V10H{begin}z"/>'
            f"{self._draw_ends(bar)}{self._draw_mark()}</svg>"
            f'<span class="num">{escape(text)}</span>'
        )

    def _place_of(self, value: float) -> int:
        shown = [v for bar in self._bars for v in (bar.value, *(bar.ends or ()))]
        low, high = min([0.0, *shown]), max([0.0, *shown])
        return round(float((value - low) / ((high - low) or 1.0) * _WIDTH))

    def _draw_ends(self, bar: _Bar) -> str:
        if bar.ends is None:
            return ""
        low, high = map(self._place_of, bar.ends)
        path = f"M{low} 2V8M{low} 5H{high}M{high} 2V8"
        return f'<path class="l" vector-effect="non-scaling-stroke" d="{path}"/>'

    def _draw_mark(self) -> str:
        if self._mark is None or not self._bars:
            return ""
        return f'<path class="l mark cm" d="M{min(self._place_of(self._mark), _WIDTH)} 0V10"/>'
