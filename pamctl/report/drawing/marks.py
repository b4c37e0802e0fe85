"""The elements of a plot: lines, bands, points, bars, maps, marked values.

Each function turns data into SVG in a frame of `FRAME_WIDTH` by the frame's height, in tenths of
a pixel. The frame is stretched to the reader's screen; the page's style keeps strokes at their
width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.report.drawing.decimate import find_unbroken, keep_extremes, thin_cloud
from pamctl.report.drawing.scale import Scale

Floats = NDArray[np.float64]

FRAME_WIDTH = 7200
PIXEL = 10.0
"""Tenths of a pixel per pixel."""
CLOUD_CELL = 3.0 * PIXEL


class Frame(NamedTuple):
    """The frame in which an element is drawn."""

    x: Scale
    y: Scale
    height: float

    def across(self, values: Floats) -> Floats:
        """Return horizontal places; values far outside are drawn just outside."""
        return np.clip(self.x.places(values), -1.0, 2.0) * FRAME_WIDTH

    def down(self, values: Floats) -> Floats:
        """Return vertical places, from the top."""
        return (1.0 - np.clip(self.y.places(values), -1.0, 2.0)) * self.height


@dataclass(frozen=True)
class PlotMark:
    """Data in a plot: the range for the axes, the text for the legend, and how to draw it."""

    xs: Sequence[Floats]
    ys: Sequence[Floats]
    label: str
    css: str
    draw: Callable[[Frame], str]
    kind: str = ""
    """`line`, `step`, `points` or `band`, which a script can draw from `xs` and `ys`."""


def draw_line(frame: Frame, x: Floats, y: Floats, css: str, *, step: bool = False) -> str:
    """Draw a line; x must not fall. With `step` each value holds until the next point."""
    across, down = frame.across(x), frame.down(y)
    if step and len(across):
        across, down = np.repeat(across, 2)[1:], np.repeat(down, 2)[:-1]
    parts = []
    for part in find_unbroken(across, down):
        kept = keep_extremes(across[part], down[part], PIXEL)
        parts.append(draw_polyline(across[part][kept], down[part][kept]))
    return f'<path class="{css}" d="{"".join(parts)}"/>'


DENSITY_CELL = 6.0 * PIXEL
DENSITIES = 5
"""Shades of a density, from one point in a cell to the most."""


def draw_density(frame: Frame, x: Floats, y: Floats, css: str) -> str:
    """Shade a plane by how many points lie in each cell, on a logarithmic scale."""
    across, down = frame.across(x), frame.down(y)
    inside = np.isfinite(across) & np.isfinite(down)
    edges = (_edge_cells(FRAME_WIDTH), _edge_cells(frame.height))
    counts, _, _ = np.histogram2d(across[inside], down[inside], edges)
    most = max(float(counts.max()), 2.0)
    shades = np.where(counts > 0, 1 + np.floor(np.log(counts.clip(1)) / np.log(most) * 4.999), 0)
    width, height = (edge[1] for edge in edges)
    return "".join(
        f'<path class="{css}" fill-opacity="{shade / DENSITIES:.1f}" d="'
        + "".join(
            f"M{left * width:.0f} {top * height:.0f}h{width:.0f}v{height:.0f}h-{width:.0f}z"
            for left, top in np.argwhere(shades == shade).tolist()
        )
        + '"/>'
        for shade in range(1, DENSITIES + 1)
    )


def _edge_cells(length: float) -> Floats:
    return np.linspace(0.0, length, round(length / DENSITY_CELL) + 1)


def hides_line(frame: Frame, lines: Sequence[PlotMark]) -> bool:
    """Return whether half of a line, which must not fall in x, lies below a later one."""
    drawn = [_find_ink(frame, line.xs[0], line.ys[0]) for line in lines]
    for place, (low, high) in enumerate(drawn):
        ink = np.nansum(high - low)
        for above, below in drawn[place + 1 :]:
            covered = np.minimum(high, below) - np.maximum(low, above)
            if ink and np.nansum(covered.clip(min=0.0)) > 0.5 * ink:
                return True
    return False


def _find_ink(frame: Frame, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the highest and the lowest place of a line in each column; NaN where it has none."""
    columns = FRAME_WIDTH // round(PIXEL)
    across, down = frame.across(x), frame.down(y)
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


def draw_band(frame: Frame, x: Floats, low: Floats, high: Floats, css: str) -> str:
    """Fill the area between two lines with the same x, which must not fall."""
    across, top, bottom = frame.across(x), frame.down(high), frame.down(low)
    parts = []
    for part in find_unbroken(across, top + bottom):
        upper = keep_extremes(across[part], top[part], PIXEL)
        lower = keep_extremes(across[part], bottom[part], PIXEL)[::-1]
        round_x = np.concatenate((across[part][upper], across[part][lower]))
        round_y = np.concatenate((top[part][upper], bottom[part][lower]))
        parts.append(draw_polyline(round_x, round_y) + "z")
    return f'<path class="{css}" d="{"".join(parts)}"/>'


def draw_points(frame: Frame, x: Floats, y: Floats, css: str) -> str:
    """Draw a cloud of points."""
    across, down = frame.across(x), frame.down(y)
    shown = np.isfinite(across) & np.isfinite(down)
    across, down = across[shown], down[shown]
    kept = thin_cloud(across, down, CLOUD_CELL)
    columns, rows = np.rint(across[kept]).astype(int), np.rint(down[kept]).astype(int)
    places = zip(columns.tolist(), rows.tolist(), strict=True)
    # A line of zero length with round ends is a dot that stays round in a stretched frame.
    return f'<path class="{css}" d="{"".join(f"M{x} {y}h0" for x, y in places)}"/>'


def draw_bars(frame: Frame, edges: Floats, counts: Floats, css: str) -> str:
    """Draw a histogram: `counts` of shape (n,) between `edges` of shape (n + 1,)."""
    sides, tops, bottom = frame.across(edges), frame.down(counts), frame.height
    outline = "".join(
        f"M{left:.0f} {bottom:.0f}V{top:.0f}H{right:.0f}V{bottom:.0f}z"
        for left, right, top, count in zip(sides[:-1], sides[1:], tops, counts, strict=True)
        if count > 0 and np.isfinite(left + right + top)
    )
    return f'<path class="{css}" d="{outline}"/>'


class HeatRange(NamedTuple):
    """The values at the two ends of the colour scale."""

    low: float
    high: float


def draw_cells(
    frame: Frame, x_edges: Floats, y_edges: Floats, values: Floats, shown: HeatRange
) -> str:
    """Draw a map of `values`, shape (rows, columns), over cell edges; NaN stays empty."""
    across, down = frame.across(x_edges), frame.down(y_edges)
    span = (shown.high - shown.low) or 1.0
    return "".join(
        f'<rect x="{across[column]:.0f}" y="{down[row + 1]:.0f}" '
        f'width="{across[column + 1] - across[column]:.0f}" '
        f'height="{down[row] - down[row + 1]:.0f}" '
        f'fill="{heat_colour((value - shown.low) / span)}"><title>{value:.4g}</title></rect>'
        for (row, column), value in np.ndenumerate(values)
        if np.isfinite(value)
    )


HEAT = ((0, 34, 78), (65, 77, 107), (124, 123, 120), (188, 175, 111), (255, 234, 70))
"""Five stops of the colour map cividis, which is monotonic also for colour-blind readers."""


def heat_colour(share: float) -> str:
    """Return the colour at a fraction of the way from the lowest to the highest value."""
    at = min(1.0, max(0.0, share)) * (len(HEAT) - 1)
    index = min(int(at), len(HEAT) - 2)
    mixed = (
        round(a + (at - index) * (b - a)) for a, b in zip(HEAT[index], HEAT[index + 1], strict=True)
    )
    return "#" + "".join(f"{part:02x}" for part in mixed)


def draw_polyline(x: Floats, y: Floats) -> str:
    """Return a polyline through points of shape (n,), n > 0, as short as SVG allows."""
    columns, rows = np.rint(x).astype(int), np.rint(y).astype(int)
    start = f"M{columns[0]} {rows[0]}"
    if len(columns) == 1:
        return start + "h0"
    steps = zip(np.diff(columns).tolist(), np.diff(rows).tolist(), strict=True)
    return start + "l" + "".join(_write_pair(right, down) for right, down in steps).lstrip()


def _write_pair(right: int, down: int) -> str:
    """Write two numbers; a minus sign separates them as well as a space does."""
    first = str(right) if right < 0 else f" {right}"
    return first + (str(down) if down < 0 else f" {down}")
