"""Read a text file of numbers: columns apart by comma, semicolon, tab or spaces.

One line of names stands above the numbers. Without it the columns are called 1, 2, 3, ...
"""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable

_DELIMITERS = ("\t", ";", ",")
_SPACES = " "
_COMMENTS = ("#", "%")
_EMPTY = ' \t;,"'
_SEPARATOR = re.compile(r"sep=.\s*", re.IGNORECASE)


def read_csv(path: Path) -> MeasuredTable:
    """Read a file; an empty cell is NaN. Raise ImportRefused with the line that is not a table row.

    If commas do not separate the cells, a comma within a cell is a decimal comma.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            return _parse_table(path, _number_lines(file))
    except OSError as error:
        raise ImportRefused(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        detail = "is not UTF-8 text; save it as such (Excel: CSV UTF-8)"
        raise ImportRefused(f"{path} {detail}") from error


def _parse_table(path: Path, lines: Iterator[tuple[int, str]]) -> MeasuredTable:
    first = next(lines, None)
    if first is None:
        raise ImportRefused(f"{path} is empty")
    delimiter = next((mark for mark in _DELIMITERS if mark in first[1]), _SPACES)
    cells = [cell.strip() for cell in _split_cells(first[1], delimiter)]
    if _are_numbers(cells, delimiter):
        names, lines = [str(number) for number in range(1, len(cells) + 1)], chain([first], lines)
    else:
        names = _check_names(path, cells)
    numbers, rows = _parse_numbers(path, lines, names, delimiter)
    table = np.array(numbers, float).reshape(len(rows), len(names))
    columns = {name: table[:, index].copy() for index, name in enumerate(names)}
    return MeasuredTable(columns, np.array(rows, np.int64))


def _number_lines(lines: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Return the lines that are not empty, each with its number.

    Excel leaves lines of empty cells below a table, and may write `sep=;` above it.
    """
    for number, line in enumerate((line.rstrip("\n") for line in lines), 1):
        says_nothing = not line.strip(_EMPTY) or (number == 1 and _SEPARATOR.fullmatch(line))
        if not says_nothing and not line.lstrip().startswith(_COMMENTS):
            yield number, line


def _split_cells(line: str, delimiter: str) -> list[str]:
    if delimiter == _SPACES:
        return line.split()
    return next(csv.reader([line], delimiter=delimiter))


def _are_numbers(cells: Sequence[str], delimiter: str) -> bool:
    return all(_is_number(_read_decimal(cell, delimiter)) for cell in cells if cell)


def _read_decimal(cell: str, delimiter: str) -> str:
    """Return a cell with a decimal point: where commas do not separate, they are decimal."""
    return cell if delimiter == "," else cell.replace(",", ".")


def _check_names(path: Path, names: list[str]) -> list[str]:
    twice = {name for name in names if names.count(name) > 1 and name}
    if twice:
        raise ImportRefused(f"{path} has more than one column {', '.join(sorted(twice))}")
    return names


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _parse_numbers(
    path: Path, lines: Iterator[tuple[int, str]], names: Sequence[str], delimiter: str
) -> tuple[array[float], array[int]]:
    """Return all numbers row by row, and the line number of each row."""
    numbers, rows = array("d"), array("q")
    for number, line in lines:
        cells = _split_cells(line, delimiter)
        if len(cells) != len(names):
            detail = f"has {len(cells)} cells, but the first line has {len(names)}"
            raise ImportRefused(f"{path}:{number}: the line {detail}")
        decimal = [_read_decimal(cell, delimiter) for cell in cells]
        try:
            numbers.extend([float(cell) if cell.strip() else math.nan for cell in decimal])
        except ValueError:
            index = next(i for i, c in enumerate(decimal) if c.strip() and not _is_number(c))
            detail = f"{names[index]} is {cells[index]!r}, but must be a number"
            raise ImportRefused(f"{path}:{number}: {detail}") from None
        rows.append(number)
    return numbers, rows
