"""What an import answers: a page with every column of the file, and a small plot of each used one.

It is short: one line a column, one line for what looks odd, and the map where nothing was imported.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pamctl.log.check import LogFinding
from pamctl.log.importing.column_map import TIME
from pamctl.log.importing.measured_table import Floats

_BARS = (
    "\N{LOWER ONE EIGHTH BLOCK}\N{LOWER ONE QUARTER BLOCK}\N{LOWER THREE EIGHTHS BLOCK}"
    "\N{LOWER HALF BLOCK}\N{LOWER FIVE EIGHTHS BLOCK}\N{LOWER THREE QUARTERS BLOCK}"
    "\N{LOWER SEVEN EIGHTHS BLOCK}\N{FULL BLOCK}"
)
_PLOT_WIDTH = 32
_PIECES = 100
"""Parts of the record in which a column rests or not."""
_STILL = 0.002
"""A column whose mean moves by less than this share of its span from part to part rests."""


@dataclass(frozen=True)
class ImportedColumn:
    """A column of the file, and what became of it."""

    number: int
    name: str
    read_as: str
    """Quantity and unit; empty for a column that is left out."""
    left_out: str
    """Why; empty for a column that is used."""
    lowest: float | None
    """In the unit of the file."""
    highest: float | None
    missing: int
    rests: float | None
    """Share of the record in which it hardly moves."""
    plot: str
    """Its course in blocks, from its lowest to its highest value."""


def describe_column(
    number: int, name: str, values: Floats, *, read_as: str = "", left_out: str = ""
) -> ImportedColumn:
    """Return what the page says of a column, values of shape (n,) as the file has them."""
    good = values[np.isfinite(values)]
    plot, rests = "", None
    if read_as and len(good) and not read_as.startswith(TIME):
        moves = np.abs(np.diff(_average(values, max(min(_PIECES, len(values) // 10), 1))))
        rests = float(np.mean(moves <= _STILL * np.ptp(good))) if len(moves) else None
        plot = draw_course(values, _PLOT_WIDTH)
    low, high = (float(good.min()), float(good.max())) if len(good) else (None, None)
    missing = len(values) - len(good)
    return ImportedColumn(number, name, read_as, left_out, low, high, missing, rests, plot)


def draw_course(values: Floats, width: int) -> str:
    """Return the course of values of shape (n,) in so many characters; a space where none are."""
    heights = _average(values, min(width, len(values)))
    low, span = np.nanmin(heights), np.nanmax(heights) - np.nanmin(heights)
    levels = np.nan_to_num((heights - low) / (span or 1.0) * (len(_BARS) - 1) + 0.5)
    return "".join(
        " " if np.isnan(height) else _BARS[int(level)]
        for height, level in zip(heights, levels, strict=True)
    )


def _average(values: Floats, count: int) -> Floats:
    """Return the means of so many pieces, shape (count,); NaN for one without values."""
    pieces = [piece[np.isfinite(piece)] for piece in np.array_split(values, count)]
    return np.array([piece.mean() if len(piece) else np.nan for piece in pieces])


def format_page(
    head: str, columns: tuple[ImportedColumn, ...], findings: tuple[LogFinding, ...], map_text: str
) -> Iterator[str]:
    """Yield the lines of the page."""
    yield head
    name_width = min(max((len(column.name) for column in columns), default=0), 28)
    role_width = min(max((len(column.read_as) for column in columns), default=0), 40)
    yield f"  {'':>3} {'column':<{name_width}}  {'read as':<{role_width}}  from .. to"
    for column in columns:
        name = f"  {column.number:>3} {column.name:<{name_width}}"
        if column.left_out:
            yield f"{name}  left out: {column.left_out}"
            continue
        ends = "no values"
        if column.lowest is not None and column.highest is not None:
            ends = f"{column.lowest:.6g} .. {column.highest:.6g}"
        rests = f", rests {column.rests:.0%}" if column.rests else ""
        gone = f", {column.missing} missing" if column.missing else ""
        plot = f"{column.plot:<{_PLOT_WIDTH}}"
        yield f"{name}  {column.read_as:<{role_width}}  {plot}  {ends}{rests}{gone}"
    for finding in findings:
        yield f"  {finding.severity:<8} {finding.kind:<11} {finding.message}"
    if map_text:
        yield "With --map FILE, which may say:"
        yield from (f"  {line}" for line in map_text.splitlines())
