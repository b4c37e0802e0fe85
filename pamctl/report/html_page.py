"""One HTML file that holds a whole report: no network; light, dark and in print.

Every text is escaped, and loses its control characters. There is no script, unless the page is
asked to be interactive: then its plots over time and frequency zoom, and have a cursor. Every
drawn picture stays in the page: a browser without scripts shows it, and `uplot/plots.js` replaces
it. The page's policy permits these two scripts by their hashes, and nothing else.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from html import escape
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from pamctl.base.texts import clean_lines, clean_text, to_json
from pamctl.report.axes import Floats, PlotAxis, Scale
from pamctl.report.figure import Levels, Plot, share_axis
from pamctl.report.picture import draw_levels, draw_plot
from pamctl.report.report import (
    Facts,
    Figure,
    Fold,
    Part,
    Points,
    Problems,
    Report,
    ReportTable,
    Section,
    Text,
    is_number_column,
)

_SHEETS = files("pamctl.report") / "page"
COLOURS = _SHEETS.joinpath("colours.css").read_text()
"""The colours and letters of every page; the live page has them too."""
STYLE = COLOURS + _SHEETS.joinpath("page.css").read_text()
"""The style sheet of all written pages."""

_SHORT, _DIGIT_PX = 16, 7
_CODE = re.compile("`([^`]+)`")
_POLICY = ("default-src 'none'", "style-src 'unsafe-inline'")
"""The browser itself refuses to load or send anything."""


def write_html(report: Report, *, interactive: bool = False) -> str:
    """Return the page of a report. If `interactive`, its plots can be zoomed and have a cursor."""
    zoomed: list[Plot] | None = [] if interactive else None
    title = escape(report.title)
    under = f'<p class="subtitle">{escape(report.subtitle)}</p>' if report.subtitle else ""
    verdict = [_write_part(Text(report.verdict, report.kind))] if report.verdict else []
    links: list[str] = []
    body, figures = verdict, 0
    for part in report.parts:
        if isinstance(part, Section) and not part.is_part:
            links.append(f'<a href="#s{len(links) + 1}">{escape(part.heading)}</a>')
            body.append(f'<h2 id="s{len(links)}">{escape(part.heading)}</h2>')
        elif isinstance(part, Section):
            level = "h3" if links else "h2"
            body.append(f"<{level}>{escape(part.heading)}</{level}>")
        elif isinstance(part, Figure):
            figures += 1
            number = f"<b>Figure {figures}.</b> " if report.numbers_figures else ""
            under_it = f"<figcaption>{number}{escape(part.caption)}</figcaption>"
            drawn = _draw_figure(part, zoomed)
            body.append(f"<figure>{drawn}{under_it if part.caption else ''}</figure>")
        else:
            body.append(_write_part(part))
    contents = f"<nav>{''.join(links)}</nav>" if len(links) > 1 else ""
    policy, style, script = list(_POLICY), STYLE, ""
    if zoomed:
        embedded = embed_plots(zoomed)
        policy.append(embedded.policy)
        style, script = style + embedded.style, embedded.body
    whole = clean_lines(
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(policy)}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{title}</title><style>{style}</style></head>\n<body><main>"
        f"<header><h1>{title}</h1>{under}{contents}</header>\n" + "\n".join(body) + "\n</main>"
    )
    return f"{whole}{script}</body></html>\n"


def _write_part(part: Part) -> str:
    match part:
        case Text(text, "text"):
            return f"<p>{_format_inline(text)}</p>"
        case Text(text, kind):
            return f'<p class="callout {escape(kind)}">{_format_inline(text)}</p>'
        case Points(items):
            return f"<ul>{''.join(f'<li>{_format_inline(item)}</li>' for item in items)}</ul>"
        case Problems(items):
            rows = [[p.level, p.where or p.key, p.message, p.fix] for p in items]
            return _write_table(ReportTable(["", "where", "what", "fix"], rows))
        case Facts(facts):
            pairs = (
                f"<div><dt>{escape(str(name))}</dt><dd>{escape(str(value))}</dd></div>"
                for name, value in facts.items()
            )
            return f'<dl class="facts">{"".join(pairs)}</dl>'
        case Fold(heading, text):
            return (
                f"<details><summary>{escape(heading)}</summary>"
                f'<pre tabindex="0">{escape(text)}</pre></details>'
            )
        case ReportTable():
            return _write_table(part)
    raise TypeError(f"a page cannot show {part!r}")


def _write_table(table: ReportTable) -> str:
    # A column of numbers is right-aligned, with its head and its dashes; short texts stay whole.
    columns = zip(*table.rows, strict=True) if table.rows else ([] for _ in table.header)
    classes = [
        ' class="num"'
        if is_number_column(column)
        else ' class="short"' * all(len(cell) <= _SHORT for cell in column)
        for column in columns
    ]

    def write_row(cells: Sequence[str], tag: str) -> str:
        begin = 'th scope="col"' if tag == "th" else tag
        pairs = zip(classes, cells, strict=True)
        return "".join(f"<{begin}{css}>{escape(cell)}</{tag}>" for css, cell in pairs)

    rows = "".join(f"<tr>{write_row(row, 'td')}</tr>" for row in table.rows)
    titled = f'<p class="caption">{escape(table.caption)}</p>' if table.caption else ""
    return (
        f'{titled}<div class="wide" role="group" tabindex="0" aria-label="table"><table>'
        f"<thead><tr>{write_row(table.header, 'th')}</tr></thead>"
        f"<tbody>{rows}</tbody></table></div>"
    )


def _draw_figure(figure: Figure, zoomed: list[Plot] | None) -> str:
    """Return a figure as HTML; put its plots that a script may draw into `zoomed`, if given."""
    if not figure.is_grid:
        share_axis([plot for plot in figure.plots if isinstance(plot, Plot)], "x")
    parts = []
    for plot in figure.plots:
        if isinstance(plot, Levels):
            parts.append(draw_levels(plot))
        elif zoomed is not None and plot.can_be_zoomed:
            parts.append(f'<div data-plot="{len(zoomed)}">{draw_plot(plot)}</div>')
            zoomed.append(plot)
        else:
            parts.append(draw_plot(plot))
    drawn = [plot for plot in figure.plots if isinstance(plot, Plot)]
    letters = max((plot.longest_number for plot in drawn), default=0)
    css = ' class="grid2"' if figure.is_grid else ""
    return f'<div{css} style="--numbers:{letters * _DIGIT_PX + 8}px">{"".join(parts)}</div>'


def _format_inline(text: str) -> str:
    return _CODE.sub(r"<code>\1</code>", escape(text))


class EmbeddedPlots(NamedTuple):
    """What makes a page interactive."""

    policy: str
    """What the page's policy must permit."""
    style: str
    body: str
    """Data and scripts, for the end of the page."""


def embed_plots(plots: Sequence[Plot]) -> EmbeddedPlots:
    """Return data and scripts for plots, which stand in the page as `data-plot="0"` and so on."""
    arrays = _Arrays()
    described = [_describe_plot(plot, arrays) for plot in plots]
    data = to_json({"plots": described, "arrays": arrays.texts}).decode().replace("<", "\\u003c")
    folder = files("pamctl.report") / "uplot"
    scripts = [folder.joinpath(name).read_text() for name in ("uplot.js", "plots.js")]
    hashes = [b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    permitted = " ".join(f"'sha256-{one}'" for one in hashes)
    return EmbeddedPlots(
        f"script-src {permitted}",
        folder.joinpath("uplot.css").read_text() + folder.joinpath("plots.css").read_text(),
        f'<script type="application/json" id="plots">{data}</script>'
        + "".join(f"<script>{script}</script>" for script in scripts),
    )


class _Arrays:
    """Arrays as text, each once: plots of one run share their time."""

    def __init__(self) -> None:
        self.texts: list[tuple[str, str]] = []
        self._known: dict[bytes, int] = {}

    def add(self, values: Floats, kind: str) -> int:
        """Return the number of an array; `kind` is `f8` or, for values to look at, `f4`."""
        raw = np.ascontiguousarray(values, f"<{kind}").tobytes()
        key = sha256(kind.encode() + raw).digest()
        if key not in self._known:
            self._known[key] = len(self.texts)
            self.texts.append((kind, b64encode(raw).decode()))
        return self._known[key]


def _describe_plot(plot: Plot, arrays: _Arrays) -> dict[str, Any]:
    x_scale, y_scale = plot.scales
    marks = []
    for mark in plot.marks:
        x, ys = mark.x, mark.ys
        marks.append(
            {
                "kind": mark.kind,
                "css": mark.css,
                "label": clean_text(mark.label),
                "x": arrays.add(x, "f8"),
                "y": [arrays.add(y, "f4") for y in ys],
            }
        )
    return {
        "title": clean_text(plot.title),
        "height": plot.height_px,
        "x": {**_describe_axis(plot.x, x_scale), "named": plot.names_x},
        "y": _describe_axis(plot.y, y_scale),
        "marks": marks,
        "lines": [
            line._replace(label=clean_text(line.label))._asdict() for line in plot.straight_lines
        ],
    }


def _describe_axis(axis: PlotAxis, scale: Scale) -> dict[str, Any]:
    return {
        "label": axis.label,
        "unit": axis.unit,
        "low": scale.low,
        "high": scale.high,
        "log": scale.log,
    }
