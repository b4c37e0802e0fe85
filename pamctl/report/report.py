"""What a verb answers, said once: a terminal, a page and JSON print the same value.

    report = Report("Run of qsmc", "ended with exit code 0: the experiment ended")
    report.add(
        Section("Tracking"),
        ReportTable(["", "max, µm"], [["measured", "38.5"]]),
        Figure([plot, another], "One time axis."),
    )
    format_terminal(report)                              # for a terminal, without figures
    write_html(report)                           # pamctl.report.html_page
    report.document                              # for --json, in SI

Errors are spelled by `spell_um`, so that they have the same digits everywhere.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from pamctl.base.errors import Problem
from pamctl.report.figure import Levels, Plot


class Section(NamedTuple):
    """The head of a section, with an entry in the contents; of a part of one without it."""

    heading: str
    is_part: bool = False


class Text(NamedTuple):
    """A paragraph, or a note. On a page, text `between backticks` is code."""

    text: str
    kind: str = "text"
    """`text`, or of a note `note`, `good` or `bad`."""


class Points(NamedTuple):
    """A list."""

    items: Sequence[str]


class Problems(NamedTuple):
    """What was checked: a line each, and below it what it should be and the fix."""

    items: Sequence[Problem]


class Facts(NamedTuple):
    """Names and values."""

    facts: Mapping[str, object]


class ReportTable(NamedTuple):
    """A table; every row is as long as the header."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""

    def drop_empty(self) -> ReportTable:
        """Leave out the columns in which no row says anything."""
        said = [
            any(cell not in ("", "-") for cell in cells) for cells in zip(*self.rows, strict=True)
        ]
        kept = [k for k in range(len(self.header)) if not said or said[k]]
        rows = [[row[k] for k in kept] for row in self.rows]
        return ReportTable([self.header[k] for k in kept], rows, self.caption)


class Figure(NamedTuple):
    """Plots in a column with one x axis; as a grid in a row, each with its own."""

    plots: Sequence[Plot | Levels]
    caption: str = ""
    is_grid: bool = False


class Fold(NamedTuple):
    """A long text, which a page shows on demand and in print, and a terminal not at all."""

    heading: str
    text: str


Part = Section | Text | Points | Problems | Facts | ReportTable | Figure | Fold


@dataclass
class Report:
    """An answer: what it is about, the verdict in a sentence, and what it rests on."""

    title: str
    verdict: str = ""
    kind: str = "note"
    """How a page shows the verdict."""
    subtitle: str = ""
    parts: list[Part] = field(default_factory=list)
    document: Mapping[str, object] = field(default_factory=dict)
    """The answer for programs, in SI."""
    numbers_figures: bool = True
    """Count the figures; switch it off if they have numbers of their own."""

    def add(self, *parts: Part) -> Report:
        """Write further parts; return the report."""
        self.parts += parts
        return self


def format_terminal(report: Report) -> str:
    """Return a report for a terminal of any language; figures and folded texts are left out."""
    lines = [(report.verdict or report.title).replace("`", "")]
    before: Part | None = None
    for part in _drop_empty_sections(report.parts):
        is_apart = isinstance(part, Section | ReportTable | Facts)
        is_apart = is_apart or isinstance(before, ReportTable | Facts)
        if is_apart and not isinstance(before, Section) and lines[-1]:
            lines.append("")
        shown = [*_list_lines(part)]
        lines += shown
        before = part if shown else before
    return to_ascii("\n".join(line.rstrip() for line in lines))


def _drop_empty_sections(parts: Sequence[Part]) -> Iterator[Part]:
    """Yield the parts without the heads of sections that a terminal shows nothing of."""
    head: Section | None = None
    for part in parts:
        if isinstance(part, Section):
            head = part
        elif not isinstance(part, Figure | Fold):
            if head is not None:
                yield head
            head = None
            yield part


_WIDTH = 100


def format_part(part: Part) -> str:
    """Return one part for a terminal: of an answer that is printed while it is found."""
    return to_ascii("\n".join(line.rstrip() for line in _list_lines(part)))


def _list_lines(part: Part) -> Iterator[str]:
    if isinstance(part, Section):
        yield part.heading
    elif isinstance(part, Text):
        yield part.text.replace("`", "")
    elif isinstance(part, Points):
        for item in part.items:
            yield from textwrap.wrap(
                f"- {item}".replace("`", ""),
                _WIDTH,
                subsequent_indent="  ",
                break_long_words=False,
                break_on_hyphens=False,
            )
    elif isinstance(part, Problems):
        said = {""}
        for where, key, message, level, wanted, fix, _ in part.items:
            yield f"{level:<8} {where or key:<22} {message}"
            if wanted and level != "ok":
                yield f"{'':<31} should be: {wanted}"
            if fix not in said and level != "ok":  # one fix may mend many
                yield f"{'':<31} fix: {fix}"
                said.add(fix)
    elif isinstance(part, Facts):
        width = max(map(len, part.facts), default=0)
        yield from (f"{name:<{width}}  {value}" for name, value in part.facts.items())
    elif isinstance(part, ReportTable):
        if part.caption:
            yield part.caption
        columns = list(zip(part.header, *part.rows, strict=True))
        widths = [max(map(len, column)) for column in columns]
        to_right = [is_number_column(column[1:]) for column in columns]
        for row in (part.header, *part.rows):
            cells = zip(row, widths, to_right, strict=True)
            yield "  ".join(
                cell.rjust(width) if right else cell.ljust(width) for cell, width, right in cells
            )


_ASCII = str.maketrans(
    {"µ": "u", "±": "+-", "\N{MINUS SIGN}": "-", "³": "^3", "\N{MULTIPLICATION SIGN}": "x"}
)


def to_ascii(text: str) -> str:
    """Return a text that a terminal of any language can show."""
    return text.translate(_ASCII)


_NOT_NUMBERS = ("", "-", "nan", "trips")


def is_number_column(cells: Sequence[str]) -> bool:
    """Tell whether all cells are numbers, or dashes for those that are missing."""
    return any(cells) and all(cell in _NOT_NUMBERS or _is_number(cell) for cell in cells)


def _is_number(cell: str) -> bool:
    bare = cell.strip("<> ").replace("\N{MINUS SIGN}", "-")
    for cut in (" ±", " +-", " ", "\N{MULTIPLICATION SIGN}", "x", "%", "/", ":"):
        bare = bare.split(cut)[0]
    try:
        float(bare.replace(",", ""))
    except ValueError:
        return False
    return True


def spell_um(value_m: float | None) -> str:
    """Write an error in micrometres without the unit; a dash where there is none."""
    return "-" if value_m is None or not math.isfinite(value_m) else f"{value_m * 1e6:.1f}"


# --- signals: users think in mm, µm and kPa ----------------------------------------------------

LARGE_GAP = 1e4
"""A gap of more of its units is shown in the unit of the signal: 20 mm, not 2e+04 µm."""


class SignalDisplay(NamedTuple):
    """Its title, and the units of itself and of a gap with their factors from SI."""

    title: str
    unit: str
    factor: float
    gap_unit: str
    gap_factor: float

    @property
    def short(self) -> str:
        """The title without its detail, in a sentence."""
        return self.title.split(",")[0].lower()

    def choose_unit(self, largest: float) -> tuple[float, str]:
        """Return factor and unit for all gaps of a signal; `largest` is the largest of them, SI.

        A large one is shown as the signal is: one unit on the whole page.
        """
        if largest * self.gap_factor < LARGE_GAP:
            return self.gap_factor, self.gap_unit
        return self.factor, self.unit


SIGNAL_DISPLAYS: Mapping[str, SignalDisplay] = {
    "position_m": SignalDisplay("Displacement", "mm", 1e3, "µm", 1e6),
    "pressure_pa": SignalDisplay("Pressure, absolute", "kPa", 1e-3, "kPa", 1e-3),
    "force_n": SignalDisplay("Force", "N", 1.0, "N", 1.0),
}


def spell_figure(value: float) -> str:
    """Return a figure with three digits, and a large one without a power of ten."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
