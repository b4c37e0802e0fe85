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
from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple, Protocol

from pamctl.plain_text import clean_lines
from pamctl.report.drawing.svg import SvgPlot, share_x_axis
from pamctl.report.style import STYLE

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
            from pamctl.report.interactive.embed_plots import embed_plots

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
