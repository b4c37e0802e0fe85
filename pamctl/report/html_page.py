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

from pamctl.json_text import to_json
from pamctl.plain_text import clean_lines, clean_text
from pamctl.report.figure import Floats, Levels, Plot, PlotAxis, Scale, share_axis
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

COLOURS = """
:root{color-scheme:light dark;--bg:#fff;--fg:#1c2024;--dim:#5c6670;--rule:#dfe3e8;--panel:#f6f7f9;
--plot:#fff;--c0:#0072b2;--c1:#d55e00;--c2:#009e73;--c3:#cc79a7;--c4:#e69f00;--c5:#56b4e9;
--c6:#1c2024;--cm:#8a939c;--good:#00785a;--warn:#8a5a00;--bad:#c02d12}
@media(prefers-color-scheme:dark){:root{--bg:#14171a;--fg:#e4e7ea;--dim:#9aa4ae;--rule:#2e343a;
--panel:#1d2125;--plot:#191c20;--c0:#56b4e9;--c1:#f0803c;--c2:#1fc294;--c3:#dd93bb;--c4:#e6b84a;
--c5:#3f8fd0;--c6:#e4e7ea;--cm:#87919b;--good:#3fcf9f;--warn:#e6b84a;--bad:#ff8a6a}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--fg);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif;
-webkit-text-size-adjust:100%}
"""
"""The colours and letters of every page; the live page has them too."""

_PAGE = """main{max-width:960px;margin:0 auto;padding:24px 20px 64px}
header{margin-bottom:14px}
h1{font-size:26px;line-height:1.2;margin:0 0 4px;overflow-wrap:anywhere}
h2{font-size:20px;margin:40px 0 10px;padding-top:10px;border-top:1px solid var(--rule)}
h3,h2:not([id]){font-size:16px;margin:24px 0 6px;padding:0;border:0}
p{margin:8px 0;max-width:75ch;overflow-wrap:anywhere}
ul{margin:8px 0;padding-left:22px;max-width:75ch}
.subtitle{color:var(--dim);margin:0}
nav{display:flex;flex-wrap:wrap;gap:4px 16px;margin:14px 0 0;font-size:14px}
a{color:var(--c0);text-decoration:none}a:hover{text-decoration:underline}
.callout{border-left:4px solid var(--cm);background:var(--panel);padding:8px 12px;max-width:none}
.callout.bad{border-color:var(--bad)}.callout.good{border-color:var(--good)}
.facts{display:grid;grid-template-columns:repeat(auto-fill,minmax(200px,1fr));gap:10px 20px;
margin:14px 0}
.facts dt{color:var(--dim);font-size:13px}.facts dd{margin:0;overflow-wrap:anywhere}
.wide{overflow-x:auto;margin:12px 0;background:
linear-gradient(90deg,var(--bg) 40%,transparent) 0 0/36px 100% no-repeat local,
linear-gradient(270deg,var(--bg) 40%,transparent) 100% 0/36px 100% no-repeat local,
linear-gradient(90deg,var(--cm),transparent) 0 0/6px 100% no-repeat scroll,
linear-gradient(270deg,var(--cm),transparent) 100% 0/6px 100% no-repeat scroll}
table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums}
.caption{color:var(--dim);font-size:14px;margin:14px 0 0}.caption+.wide{margin-top:4px}
th,td{padding:4px 14px 4px 0;text-align:left;vertical-align:top;border-bottom:1px solid var(--rule)}
th{color:var(--dim);font-weight:600}.num{text-align:right}td.num{white-space:nowrap}
.short{white-space:nowrap}td:not(.num):not(.short){min-width:10em}
figure{margin:16px 0 24px}
figcaption{color:var(--dim);font-size:14px;margin-top:6px;max-width:85ch}
.plot{break-inside:avoid;margin-bottom:6px;min-width:0}
.ptitle{font-weight:600;font-size:14px;margin:6px 0 2px}
.ptitle .unit{color:var(--dim);font-weight:400;margin-left:6px}
.frame{padding:0 10px 0 max(56px,var(--numbers,0px))}
.grid2{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,400px),1fr));gap:8px 24px}
.levels{display:grid;grid-template-columns:max-content 1fr max-content;gap:4px 10px;
align-items:center;font-size:14px}.levels svg{width:100%;height:15px}
svg{display:block;overflow:visible}
svg.open{overflow:visible}svg.data{overflow:hidden}
svg text{font-size:12px;fill:var(--dim)}
.paper{fill:var(--plot);stroke:var(--rule)}
.grid{stroke:var(--rule);stroke-width:1}
.yt{text-anchor:end}.xt{text-anchor:middle}.xl{text-anchor:end}
.note{fill:var(--fg);paint-order:stroke;stroke:var(--plot);stroke-width:3px}.note.end{text-anchor:end}.note.mid{text-anchor:middle}
.l,.p{fill:none;stroke:currentColor;stroke-width:1.3;stroke-linejoin:round;stroke-linecap:round;
vector-effect:non-scaling-stroke}
.l.thick{stroke-width:3}.l.mark{stroke-width:1.2;stroke-dasharray:6 4}
.p{stroke-width:3.2;opacity:.7}.p.few{stroke-width:6}
.b{fill:currentColor;opacity:.22;stroke:none}.b.solid{opacity:.75}.d{fill:currentColor}
.c0{color:var(--c0)}.c1{color:var(--c1)}.c2{color:var(--c2)}.c3{color:var(--c3)}
.c4{color:var(--c4)}.c5{color:var(--c5)}.c6{color:var(--c6)}.cm{color:var(--cm)}
.legend{list-style:none;display:flex;flex-wrap:wrap;gap:2px 16px;margin:0 0 2px;padding:0;
font-size:13px;color:var(--dim);max-width:none}
.legend li{display:flex;align-items:center;gap:6px;overflow-wrap:anywhere}
.swatch{width:22px;height:10px;flex:none}.shades{width:110px;height:10px}
.heat{display:inline-block;width:120px;height:10px}
details{margin:10px 0}summary{cursor:pointer;font-weight:600}
code{background:var(--panel);padding:1px 4px;font-size:13px;white-space:nowrap}
pre{overflow-x:auto;background:var(--panel);padding:10px 12px;font-size:12.5px;line-height:1.4}
@media(max-width:600px){main{padding:16px 12px 48px}h1{font-size:22px}
.frame{padding-left:max(50px,var(--numbers,0px))}.spare{display:none}code{white-space:normal}
nav{flex-wrap:nowrap;overflow-x:auto;white-space:nowrap;padding-bottom:6px}
td,th{padding-right:6px}td:last-child,th:last-child{padding-right:0}table{font-size:13px}.short{white-space:normal}td:not(.num):not(.short){min-width:6em}.facts{grid-template-columns:repeat(2,minmax(0,1fr))}}
@media print{:root{color-scheme:light;--bg:#fff;--fg:#000;--dim:#444;--rule:#ccc;--panel:#f6f6f6;
--plot:#fff;--c0:#0072b2;--c1:#d55e00;--c2:#009e73;--c3:#cc79a7;--c4:#e69f00;--c5:#56b4e9;
--c6:#000;--cm:#777;--good:#00785a;--bad:#c02d12}
body{font-size:10.5pt}main{max-width:none;padding:0}nav{display:none}
h2,h3{break-after:avoid}.callout,tr{break-inside:avoid}
details::details-content{content-visibility:visible;display:block;height:auto}
pre{white-space:pre-wrap}.wide{overflow:visible;background:none}table{font-size:9pt}
.num,.short{white-space:normal;overflow-wrap:anywhere}@page{margin:14mm}}
"""
STYLE = COLOURS + _PAGE
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
