"""One HTML file that holds everything: no network; light, dark and in print.

    page = Page("Run of qsmc", "tracking-2, 20 November")
    page.section("Tracking")
    page.text("...")
    page.table(["", "max, um"], [["measured", "38.5"]])
    page.figure(plot, another, caption="One time axis.")
    page.fold("Configuration", text)
    Path("run.html").write_text(page.html(), encoding="utf-8")

Every text is escaped, and loses its control characters. There is no script, unless the page is
asked to be interactive: then its plots over time and frequency zoom, and have a cursor.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from hashlib import sha256
from html import escape
from importlib.resources import files
from typing import Any, NamedTuple, Protocol

import numpy as np

from pamctl.json_text import to_json
from pamctl.plain_text import clean_lines, clean_text
from pamctl.report.drawing.scale import Floats, Scale
from pamctl.report.drawing.svg import PlotAxis, SvgPlot, share_x_axis

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
.wide{overflow-x:auto;margin:12px 0}
table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums}
.caption{color:var(--dim);font-size:14px;margin:14px 0 0}.caption+.wide{margin-top:4px}
th,td{padding:4px 14px 4px 0;text-align:left;vertical-align:top;border-bottom:1px solid var(--rule)}
th{color:var(--dim);font-weight:600}.num{text-align:right;white-space:nowrap}
.short{white-space:nowrap}td:not(.num):not(.short){min-width:10em}
figure{margin:16px 0 24px}
figcaption{color:var(--dim);font-size:14px;margin-top:6px;max-width:85ch}
.plot{break-inside:avoid;margin-bottom:6px;min-width:0}
.ptitle{font-weight:600;font-size:14px;margin:6px 0 2px}
.ptitle .unit{color:var(--dim);font-weight:400;margin-left:6px}
.frame{padding:0 10px 0 56px}
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
@media(max-width:600px){main{padding:16px 12px 48px}h1{font-size:22px}.frame{padding-left:50px}
.spare{display:none}code{white-space:normal}
nav{flex-wrap:nowrap;overflow-x:auto;white-space:nowrap;padding-bottom:6px}
td,th{padding-right:10px}td:first-child{overflow-wrap:anywhere;min-width:7em}.facts{grid-template-columns:repeat(2,minmax(0,1fr))}}
@media print{:root{color-scheme:light;--bg:#fff;--fg:#000;--dim:#444;--rule:#ccc;--panel:#f6f6f6;
--plot:#fff;--c0:#0072b2;--c1:#d55e00;--c2:#009e73;--c3:#cc79a7;--c4:#e69f00;--c5:#56b4e9;
--c6:#000;--cm:#777;--good:#00785a;--bad:#c02d12}
body{font-size:10.5pt}main{max-width:none;padding:0}nav{display:none}
h2,h3{break-after:avoid}.callout,tr{break-inside:avoid}
details::details-content{content-visibility:visible;display:block;height:auto}
pre{white-space:pre-wrap}.wide{overflow:visible}@page{margin:14mm}}
"""
STYLE = COLOURS + _PAGE
"""The style sheet of all written pages."""


class EmbeddedPlots(NamedTuple):
    """What makes a page interactive."""

    policy: str
    """What the page's policy must permit."""
    style: str
    body: str
    """Data and scripts, for the end of the page."""


def embed_plots(plots: Sequence[SvgPlot]) -> EmbeddedPlots:
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


def _describe_plot(plot: SvgPlot, arrays: _Arrays) -> dict[str, Any]:
    frame = plot.make_frame()
    marks = []
    for mark in plot.marks:
        (x,), ys = mark.xs, mark.ys
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
        "x": {**_describe_axis(plot.x, frame.x), "named": plot.names_x},
        "y": _describe_axis(plot.y, frame.y),
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


_NUMBER = re.compile(
    r"^[\s<>\N{MINUS SIGN}+-]*[\d.][\d\s.,e/:%x\N{MULTIPLICATION SIGN}+-]*( [µmk]?[mNVsPa/]+)?$"
)
_SHORT = 16
_NO_NUMBER = ("", "-", "nan", "trips")
_CODE = re.compile("`([^`]+)`")
_POLICY = ("default-src 'none'", "style-src 'unsafe-inline'")
"""The browser itself refuses to load or send anything."""


class Drawable(Protocol):
    """An element of a figure: a `SvgPlot`, or `Levels`."""

    def html(self) -> str:
        """Return it as escaped HTML."""
        ...


class _Figure(NamedTuple):
    plots: Sequence[Drawable]
    under: str
    is_grid: bool


class Page:
    """A page, written from top to bottom."""

    def __init__(self, title: str, subtitle: str = "", *, numbered: bool = True) -> None:
        """`numbered` counts the figures; switch it off if they have numbers of their own."""
        self.title, self.subtitle = title, subtitle
        self._body: list[str | _Figure] = []
        self._sections: list[str] = []
        self._numbered, self._figures = numbered, 0

    def section(self, heading: str) -> None:
        """Begin a section, with an entry in the table of contents at the top."""
        self._sections.append(heading)
        self._body.append(f'<h2 id="s{len(self._sections)}">{escape(heading)}</h2>')

    def heading(self, heading: str) -> None:
        """Begin a subsection, or a part before the first section."""
        level = "h3" if self._sections else "h2"
        self._body.append(f"<{level}>{escape(heading)}</{level}>")

    def text(self, *paragraphs: str) -> None:
        """Write paragraphs. Here, in points and in notes, text `between backticks` is code."""
        self._body += [f"<p>{_format_inline(paragraph)}</p>" for paragraph in paragraphs]

    def points(self, *items: str) -> None:
        """Write a list."""
        self._body.append(
            "<ul>" + "".join(f"<li>{_format_inline(i)}</li>" for i in items) + "</ul>"
        )

    def note(self, text: str, *, kind: str = "note") -> None:
        """Write a note of kind `note`, `good` or `bad`."""
        self._body.append(f'<p class="callout {escape(kind)}">{_format_inline(text)}</p>')

    def facts(self, facts: Mapping[str, object]) -> None:
        """Write names and values."""
        pairs = (
            f"<div><dt>{escape(str(name))}</dt><dd>{escape(str(value))}</dd></div>"
            for name, value in facts.items()
        )
        self._body.append(f'<dl class="facts">{"".join(pairs)}</dl>')

    def table(
        self, header: Sequence[str], rows: Sequence[Sequence[str]], *, caption: str = ""
    ) -> None:
        """Write a table; every row is as long as the header."""
        titled = f'<p class="caption">{escape(caption)}</p>' if caption else ""
        # A column of numbers is right-aligned, with its heading and its dashes; short texts do not
        # break.
        columns = zip(*rows, strict=True) if rows else ([] for _ in header)
        classes = [_classify_column(column) for column in columns]
        head = "".join(
            f'<th scope="col"{css}>{escape(cell)}</th>'
            for css, cell in zip(classes, header, strict=True)
        )
        body = "".join(
            "<tr>"
            + "".join(
                f"<td{css}>{escape(cell)}</td>" for css, cell in zip(classes, row, strict=True)
            )
            + "</tr>"
            for row in rows
        )
        self._body.append(
            f'{titled}<div class="wide" role="group" tabindex="0" aria-label="table"><table>'
            f"<thead><tr>{head}</tr></thead>"
            f"<tbody>{body}</tbody></table></div>"
        )

    def figure(self, *plots: SvgPlot, caption: str = "", one_x: bool = True) -> None:
        """Write a figure of plots in a column, with one x axis unless `one_x` is false."""
        if one_x:
            share_x_axis(plots)
        self._add_figure(plots, caption, is_grid=False)

    def grid(self, *plots: Drawable, caption: str = "") -> None:
        """Write a figure of plots in a row; on a narrow screen in a column."""
        self._add_figure(plots, caption, is_grid=True)

    def fold(self, heading: str, text: str) -> None:
        """Write a folded text, which opens on demand and in print."""
        self._body.append(
            f"<details><summary>{escape(heading)}</summary>"
            f'<pre tabindex="0">{escape(text)}</pre></details>'
        )

    def html(self, *, interactive: bool = False) -> str:
        """Return the whole file. If `interactive`, its plots can be zoomed and have a cursor."""
        title = escape(self.title)
        links = "".join(
            f'<a href="#s{number}">{escape(heading)}</a>'
            for number, heading in enumerate(self._sections, 1)
        )
        contents = f"<nav>{links}</nav>" if len(self._sections) > 1 else ""
        under = f'<p class="subtitle">{escape(self.subtitle)}</p>' if self.subtitle else ""
        zoomed: list[SvgPlot] = []
        body = "\n".join(
            part if isinstance(part, str) else _draw_figure(part, zoomed if interactive else None)
            for part in self._body
        )
        policy, style, script = list(_POLICY), STYLE, ""
        if zoomed:
            from pamctl.report.html_page import embed_plots

            embedded = embed_plots(zoomed)
            policy.append(embedded.policy)
            style, script = style + embedded.style, embedded.body
        whole = clean_lines(
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(policy)}">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            '<meta name="color-scheme" content="light dark">'
            f"<title>{title}</title><style>{style}</style></head>\n<body><main>"
            f"<header><h1>{title}</h1>{under}{contents}</header>\n{body}\n</main>"
        )
        return f"{whole}{script}</body></html>\n"

    def _add_figure(self, plots: Sequence[Drawable], caption: str, *, is_grid: bool) -> None:
        self._figures += 1
        number = f"<b>Figure {self._figures}.</b> " if self._numbered else ""
        under = f"<figcaption>{number}{escape(caption)}</figcaption>" if caption else ""
        self._body.append(_Figure(plots, under, is_grid))


def _draw_figure(figure: _Figure, zoomed: list[SvgPlot] | None) -> str:
    """Return a figure as HTML; put its plots that a script may draw into `zoomed`, if given."""
    parts = []
    for plot in figure.plots:
        drawn = plot.html()
        if zoomed is not None and isinstance(plot, SvgPlot) and plot.can_be_zoomed:
            drawn = f'<div data-plot="{len(zoomed)}">{drawn}</div>'
            zoomed.append(plot)
        parts.append(drawn)
    inside = "".join(parts)
    grid = f'<div class="grid2">{inside}</div>' if figure.is_grid else inside
    return f"<figure>{grid}{figure.under}</figure>"


def _format_inline(text: str) -> str:
    return _CODE.sub(r"<code>\1</code>", escape(text))


def _classify_column(column: Sequence[str]) -> str:
    if any(column) and all(cell in _NO_NUMBER or _NUMBER.match(cell) for cell in column):
        return ' class="num"'
    return ' class="short"' if all(len(cell) <= _SHORT for cell in column) else ""
