"""A few numbers as named bars beside each other, such as before and after.

levels = Levels("Displacement", "µm")
levels.bar("recalibrated", 1310.0, colour=1)
levels.bar("with valve_deadband", 4.8)
levels.mark(0.9)                          # the noise of the sensor
page.grid(levels)                         # pamctl.report.html_page
"""

from __future__ import annotations

from html import escape

from pamctl.report.drawing.svg import css_of

_WIDTH = 1000


class Levels:
    """Bars from zero, in one unit and on one linear scale; no value is negative."""

    def __init__(self, title: str, unit: str) -> None:
        self.title, self.unit = title, unit
        self._bars: list[tuple[str, float, int]] = []
        self._mark: float | None = None

    def bar(self, label: str, value: float, *, colour: int = 0) -> Levels:
        """Add a bar below the others."""
        self._bars.append((label, value, colour))
        return self

    def mark(self, value: float) -> Levels:
        """Draw a line at a value across all bars; the caption explains it."""
        self._mark = value
        return self

    def html(self) -> str:
        """Return the bars as escaped HTML, without their own style."""
        rows = "".join(
            f'<span>{escape(label)}</span><svg class="data" role="img" '
            f'aria-label="{escape(f"{label}: {value:.4g} {self.unit}")}" '
            f'viewBox="0 0 {_WIDTH} 10" preserveAspectRatio="none">'
            f'<path class="b solid {css_of(colour)}" d="M0 0H{self._place_of(value)}V10H0z"/>'
            f"{self._draw_mark()}</svg>"
            f'<span class="num">{value:.4g} {escape(self.unit)}</span>'
            for label, value, colour in self._bars
        )
        return (
            f'<div class="plot"><div class="ptitle">{escape(self.title)}</div>'
            f'<div class="levels">{rows}</div></div>'
        )

    def _place_of(self, value: float) -> int:
        largest = max((v for _, v, _ in self._bars), default=0.0) or 1.0
        return max(round(value / largest * _WIDTH), 3)  # a bar of zero length stays visible

    def _draw_mark(self) -> str:
        if self._mark is None or not self._bars:
            return ""
        return f'<path class="l mark cm" d="M{min(self._place_of(self._mark), _WIDTH)} 0V10"/>'
