"""Read an Excel workbook: the one sheet that holds rows of numbers."""

from __future__ import annotations

import datetime as dt
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from openpyxl import load_workbook

from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable
from pamctl.log.importing.rows_table import HEAD_ROWS, Row, build_table, find_data

MOST_BYTES = 1 << 30
"""Unpacked; a sheet of Excel's own size is less."""


def parse_excel(path: Path) -> MeasuredTable:
    """Return the table; raise ImportRefused if no sheet, or more than one, has rows of numbers."""
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(part.file_size for part in archive.infolist())
    if unpacked > MOST_BYTES:
        size = f"{unpacked / 2**30:.1f} GB unpacked"
        raise ImportRefused(f"{path} is too large: {size}; save its sheet as CSV")
    book = load_workbook(path, read_only=True, data_only=True)
    sheets = [sheet for sheet in book.worksheets if _has_numbers(sheet)]
    if len(sheets) != 1:
        there = ", ".join(sheet.title for sheet in sheets) or "none"
        raise ImportRefused(
            f"{path}: one sheet must hold the measurement; with rows of numbers there are {there}; "
            "save that sheet as a file of its own"
        )
    return build_table(path, _read_rows(sheets[0]))


def _has_numbers(sheet: Any) -> bool:
    rows = [row.cells for row, _ in zip(_read_rows(sheet), range(HEAD_ROWS), strict=False)]
    return find_data(rows) is not None


def _read_rows(sheet: Any) -> Iterator[Row]:
    """Return the rows that are not empty, all as wide as the widest of the first ones."""
    width = 0
    for number, values in enumerate(sheet.iter_rows(values_only=True), 1):
        cells = [_write_cell(value) for value in values]
        while cells and not cells[-1]:
            cells.pop()
        if not cells:
            continue
        width = max(width, len(cells))
        yield Row(number, cells + [""] * (width - len(cells)))


def _write_cell(value: Any) -> str:
    """Return a cell's text: a point in numbers, ISO 8601 for times, nothing for an error."""
    if value is None or (isinstance(value, str) and value.startswith("#")):
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, dt.timedelta):
        return str(value)
    return value.isoformat() if isinstance(value, (dt.datetime, dt.time)) else str(value)
