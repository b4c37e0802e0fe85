"""Find the table in rows of cells: what stands above it, its names, its units, its numbers.

Bench 3; Mon 4 May            left out: it has not the table's width
Time; Pressure; Position      names
s; bar; mm                    units, if there is such a line
0,000; 1,013; 0,00            the first row of numbers
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pamctl.log.importing.header_words import read_unit
from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable
from pamctl.log.importing.text_times import ClockTime, count_seconds, read_clock

MOST_NUMBERS = 250_000_000
"""2 GB as floats."""
HEAD_ROWS = 200
"""The names stand above the numbers within as many rows."""
_LETTER = re.compile(r"[^\W\d_]")


class Row(NamedTuple):
    """One row of a file."""

    number: int
    """In the file, from 1."""
    cells: Sequence[str]
    """Decimal numbers have a point; an empty text is a missing value."""


class _Head(NamedTuple):
    names: list[str]
    units: dict[str, str]
    first: int
    """Index of the first row of numbers."""


def build_table(path: Path, rows: Iterator[Row]) -> MeasuredTable:
    """Return the columns of the rows; an empty cell is NaN.

    Columns are called 1, 2, 3, ... where no names stand above them. A column of words has no
    numbers and is left out; a column of times is in seconds. Raise ImportRefused with the line
    that is not a row of the table.
    """
    head = list(islice(rows, HEAD_ROWS))
    if not head:
        raise ImportRefused(f"{path} is empty")
    names, units, first = _read_head(path, head)
    rest = chain(head[first:], rows)
    shown = head[first].cells if first < len(head) else [""] * len(names)
    clocks = [i for i, cell in enumerate(shown) if read_clock(cell)]
    words = {i for i, cell in enumerate(shown) if _is_word(cell)} if _is_data(shown) else set()
    plain = [i for i in range(len(names)) if i not in words and i not in clocks]
    numbers, times, lines = _read_rows(path, rest, names, plain, clocks)
    table = np.array(numbers, float).reshape(len(lines), len(plain))
    columns = {names[i]: table[:, at].copy() for at, i in enumerate(plain)}
    columns |= {names[i]: count_seconds(times[i]) for i in clocks}
    ordered = {name: columns[name] for name in names if name in columns}
    units |= {names[i]: "s" for i in clocks}
    return MeasuredTable(ordered, np.array(lines, np.int64), units=units)


def find_data(rows: Sequence[Sequence[str]]) -> int | None:
    """Return the index of the first row of numbers that is followed by another; None without."""
    for index, cells in enumerate(rows):
        following = rows[index + 1] if index + 1 < len(rows) else cells
        if _is_data(cells) and _is_data(following) and len(cells) == len(following):
            return index
    return None


def _read_head(path: Path, head: Sequence[Row]) -> _Head:
    """Return names and units; the first row is the names' if no other one can be."""
    first = find_data([row.cells for row in head])
    if first is None or (first and not _may_be_names(head[first - 1], head[first])):
        if _are_numbers(head[0].cells):
            return _Head(_number_columns(head[0]), {}, 0)
        return _Head(_check_names(path, head[0].cells), {}, 1)
    if first == 0:
        return _Head(_number_columns(head[0]), {}, 0)
    above = [cell.strip() for cell in head[first - 1].cells]
    is_units = first > 1 and _may_be_names(head[first - 2], head[first]) and _are_units(above)
    names = _check_names(path, head[first - 2 if is_units else first - 1].cells)
    units = dict(zip(names, above, strict=True)) if is_units else {}
    return _Head(names, {name: unit for name, unit in units.items() if unit}, first)


def _number_columns(row: Row) -> list[str]:
    return [str(number) for number in range(1, len(row.cells) + 1)]


def _check_names(path: Path, cells: Sequence[str]) -> list[str]:
    names = [cell.strip() for cell in cells]
    twice = {name for name in names if names.count(name) > 1 and name}
    if twice:
        raise ImportRefused(f"{path} has more than one column {', '.join(sorted(twice))}")
    return names


def _may_be_names(row: Row, data: Row) -> bool:
    return len(row.cells) == len(data.cells) and not any(map(_is_number, row.cells))


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether a line states units: known ones, or in brackets; some may be missing."""
    stated = [cell for cell in cells if cell.strip("[]()- ")]
    known = [cell for cell in stated if read_unit(cell) or cell[0] + cell[-1] in ("[]", "()")]
    return bool(stated) and 2 * len(known) > len(stated)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _are_numbers(cells: Sequence[str]) -> bool:
    return all(_is_number(cell) for cell in cells if cell)


def _is_word(cell: str) -> bool:
    """Return whether a cell holds text, or a date: no number and no time."""
    return bool(cell.strip()) and not _is_number(cell) and read_clock(cell) is None


def _is_data(cells: Sequence[str]) -> bool:
    """Return whether a row has two numbers or times, and beside them only words or nothing."""
    values = sum(1 for cell in cells if _is_number(cell) or read_clock(cell))
    others = [cell for cell in cells if _is_word(cell)]
    return values >= 2 and all(_LETTER.search(c) or re.search(r"\d[-./]\d", c) for c in others)


def _read_rows(
    path: Path,
    rows: Iterator[Row],
    names: Sequence[str],
    plain: Sequence[int],
    clocks: Sequence[int],
) -> tuple[array[float], dict[int, list[ClockTime | None]], array[int]]:
    """Return all plain numbers row by row, the times by column, and the number of each row."""
    numbers, lines = array("d"), array("q")
    times: dict[int, list[ClockTime | None]] = {index: [] for index in clocks}
    for number, cells in rows:
        if len(cells) != len(names):
            detail = f"has {len(cells)} cells, but the first line has {len(names)}"
            raise ImportRefused(f"{path}:{number}: the line {detail}")
        try:
            numbers.extend([float(cell) if (cell := cells[i]).strip() else math.nan for i in plain])
        except ValueError:
            index = next(i for i in plain if cells[i].strip() and not _is_number(cells[i]))
            detail = f"{names[index]} is {cells[index]!r}, but must be a number"
            raise ImportRefused(f"{path}:{number}: {detail}") from None
        for index in clocks:
            time = read_clock(cells[index])
            if time is None and cells[index].strip():
                detail = f"{names[index]} is {cells[index]!r}, but must be a time as above"
                raise ImportRefused(f"{path}:{number}: {detail}")
            times[index].append(time)
        lines.append(number)
        if len(numbers) > MOST_NUMBERS:
            detail = f"more than {MOST_NUMBERS:.0f} numbers up to line {number}"
            raise ImportRefused(f"{path} is too large: {detail}; cut it into parts")
    return numbers, times, lines
