"""Pictures without script: a plot as SVG, at most one point for each pixel and extreme.

The data's frame is stretched to the width of screen or paper, while strokes, numbers and words
keep their size: the same figure is readable on a phone and in print. Lengths are in tenths of a
pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

import numpy as np

from pamctl.report.axes import Floats, Scale, find_unbroken, keep_extremes, thin_cloud
from pamctl.report.figure import (
    FRAME_WIDTH,
    PIXEL,
    Levels,
    Plot,
    PlotMark,
    css_of,
    place_across,
    place_down,
)
from pamctl.report.report import spell_figure

_SWATCHES = {"b": "M1 1h20v8h-20z", "l": "M1 5h20", "p": "M11 5h0"}
"""What the legend shows of bands, lines and points."""
_ABOVE, _BELOW, _BELOW_UNNAMED = 8, 42, 24
_LETTER, _MOST_ROWS = 6.5 / 700.0, 4
"""Width of a letter as a share of the usual plot, and rows of texts beside vertical lines."""


def draw_plot(plot: Plot) -> str:
    """Return a plot with its legend as escaped HTML, without its own style."""
    (x, y), px = plot.scales, plot.height_px
    name = escape(f"{plot.title}: {plot.y.title} over {plot.x.title}")
    below = _BELOW if plot.names_x else _BELOW_UNNAMED
    drawn = "".join(_draw_mark(mark, x, y, px * PIXEL) for mark in plot.marks)
    empty = "" if plot.has_data else _write(0.5, px // 2, "nothing was measured", "note mid")
    title, label = plot.title.casefold(), plot.y.label.casefold()
    is_said = title == label or title.startswith(f"{label},")
    return (
        f'<div class="plot"><div class="ptitle">{escape(plot.title)} <span class="unit">'
        f"{escape(plot.y.unit if is_said else plot.y.title)}</span></div>{_draw_legend(plot)}"
        f'<div class="frame"><svg role="img" aria-label="{name}" width="100%" '
        f'height="{px + _ABOVE + below}"><title>{name}</title>'
        f'<svg y="{_ABOVE}" width="100%" height="{px + below}" class="open">'
        f"{''.join(_draw_grid(plot, x))}"
        f'<svg class="data" width="100%" height="{px}" viewBox="0 0 {FRAME_WIDTH} '
        f'{px * PIXEL:.0f}" preserveAspectRatio="none">{drawn}{_draw_straight_lines(plot, x, y)}'
        f"</svg>{''.join(_write_labels(plot, x, y))}{empty}</svg></svg></div></div>"
    )


def _write(at: float, down: float, text: str, css: str, nudge: int = 0) -> str:
    where = f'x="{at * 100:.2f}%" dx="{nudge}" y="{round(down, 1):g}"'
    return f'<text class="{css}" {where}>{escape(text)}</text>'


def _draw_mark(mark: PlotMark, x: Scale, y: Scale, height: float) -> str:
    across = place_across(x, mark.x)
    downs = [place_down(y, values, height) for values in mark.ys]
    if mark.kind == "points":
        shown = np.isfinite(across) & np.isfinite(downs[0])
        across, down = across[shown], downs[0][shown]
        kept = thin_cloud(across, down, 3.0 * PIXEL)
        # A line of zero length with round ends is a dot that stays round in a stretched frame.
        path = "".join(f"M{a:.0f} {b:.0f}h0" for a, b in zip(across[kept], down[kept], strict=True))
    else:
        if mark.kind == "step" and len(across):
            across, downs = np.repeat(across, 2)[1:], [np.repeat(downs[0], 2)[:-1]]
        path = ""
        for part in find_unbroken(across, sum(downs)):  # type: ignore[arg-type]
            ways = [(keep_extremes(across[part], down[part], PIXEL), down[part]) for down in downs]
            # A band goes forth along its upper edge, and back along its lower one.
            forth = [(across[part][kept], down[kept]) for kept, down in ways]
            round_x = np.concatenate([a[:: 1 - 2 * k] for k, (a, _) in enumerate(forth)])
            round_y = np.concatenate([d[:: 1 - 2 * k] for k, (_, d) in enumerate(forth)])
            path += _join_points(round_x, round_y) + "z" * (len(downs) > 1)
    return f'<path class="{mark.css}" d="{path}"/>'


def _join_points(x: Floats, y: Floats) -> str:
    """Return a polyline of relative steps, the shortest that SVG allows."""
    columns, rows = np.rint(x).astype(int), np.rint(y).astype(int)
    steps = "".join(
        f"{'' if right < 0 else ' '}{right}{'' if down < 0 else ' '}{down}"
        for right, down in zip(np.diff(columns).tolist(), np.diff(rows).tolist(), strict=True)
    )
    return f"M{columns[0]} {rows[0]}" + (f"l{steps.lstrip()}" if steps else "h0")


def _draw_grid(plot: Plot, x: Scale) -> Iterator[str]:
    """Yield grid lines and numbers; a narrow x axis may omit every second number."""
    bottom = plot.height_px
    yield f'<rect class="paper" width="100%" height="{bottom}"/>'
    for place, text, _ in plot.y_ticks:
        at = (1.0 - place) * bottom
        yield f'<line class="grid" x2="100%" y1="{at:.1f}" y2="{at:.1f}"/>'
        yield _write(0.0, at + 4, text, "yt", -6)
    for place, text, spare in x.ticks(8):
        at_share = f"{place * 100:.2f}%"
        yield f'<line class="grid" x1="{at_share}" x2="{at_share}" y2="{bottom}"/>'
        yield _write(place, bottom + 16, text, "xt spare" if spare else "xt")
    if plot.names_x:
        yield _write(1.0, bottom + 34, plot.x.title, "xl")


def _draw_straight_lines(plot: Plot, x: Scale, y: Scale) -> str:
    height = plot.height_px * PIXEL
    paths = (
        (css, f"M{x.place(at) * FRAME_WIDTH:.0f} 0V{height:.0f}")
        if axis == "x"
        else (css, f"M0 {(1.0 - y.place(at)) * height:.0f}H{FRAME_WIDTH}")
        for axis, at, _, css in plot.straight_lines
        if 0.0 <= (x if axis == "x" else y).place(at) <= 1.0
    )
    return "".join(f'<path class="l mark {css}" d="{path}"/>' for css, path in paths)


def _write_labels(plot: Plot, x: Scale, y: Scale) -> Iterator[str]:
    """Yield the texts of straight lines; those of vertical ones share rows from left to right."""
    ends: list[float] = []
    for axis, at, label, _ in sorted(plot.straight_lines):
        place = (x if axis == "x" else y).place(at)
        if not label or not 0.0 <= place <= 1.0:
            continue
        if axis == "y":
            down = (1.0 - place) * plot.height_px
            yield _write(0.995, down - 4 if down > 16 else down + 13, label, "note end")
            continue
        wide, is_last = (len(label) + 2) * _LETTER, place > 0.7
        begin = place - wide if is_last else place
        row = next((k for k, end in enumerate(ends) if end <= begin), len(ends) % _MOST_ROWS)
        ends[row : row + 1] = [begin + wide]
        # On a narrow screen the texts of the first row alone have room.
        css = f"note{' end' * is_last}{' spare' * bool(row)}"
        yield _write(place, 12 + 13 * row, label, css, -4 if is_last else 4)


def _draw_legend(plot: Plot) -> str:
    entries = [
        f'<svg class="swatch" viewBox="0 0 22 10"><path class="{mark.css}" '
        f'd="{_SWATCHES[mark.css[0]]}"/></svg>{escape(mark.label)}'
        for mark in plot.marks
        if mark.label
    ]
    items = "".join(f"<li>{entry}</li>" for entry in entries)
    return f'<ul class="legend">{items}</ul>' if entries else ""


def draw_levels(levels: Levels) -> str:
    """Return named bars as escaped HTML, without their own style."""
    shown = [v for _, value, _, ends in levels.bars for v in (0.0, value, *(ends or ()))]
    low, high = min(shown, default=0.0), max(shown, default=1.0)
    scale = Scale(low, high if high > low else low + 1.0)

    def at(value: float) -> int:
        return min(round(scale.place(value) * 1000), 1000)

    rows = []
    for label, value, colour, ends in levels.bars:
        text = f"{spell_figure(value)} {levels.unit}"
        begin, end = sorted((at(0.0), at(value)))
        end = max(end, begin + 3)  # a bar of zero length stays visible
        path = f'<path class="b solid {css_of(colour)}" d="M{begin} 0H{end}V10H{begin}z"/>'
        if ends is not None:
            low, high = map(at, ends)
            path += f'<path class="l" d="M{low} 2V8M{low} 5H{high}M{high} 2V8"/>'
        if levels.marked is not None:
            path += f'<path class="l mark cm" d="M{at(levels.marked)} 0V10"/>'
        rows.append(
            f'<span>{escape(label)}</span><svg class="data" role="img" '
            f'aria-label="{escape(f"{label}: {text}")}" viewBox="0 0 1000 10" '
            f'preserveAspectRatio="none">{path}</svg><span class="num">{escape(text)}</span>'
        )
    return (
        f'<div class="plot"><div class="ptitle">{escape(levels.title)}</div>'
        f'<div class="levels">{"".join(rows)}</div></div>'
    )
