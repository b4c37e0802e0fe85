"""Read a text file of numbers: columns apart by comma, semicolon, tab or spaces."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import TextIO

from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable
from pamctl.log.importing.rows_table import HEAD_ROWS, Row, build_table, find_data

_DELIMITERS = ("\t", ";", ",")
_SPACES = " "
_COMMENTS = ("#", "%")
_EMPTY = ' \t;,"'
_LONGEST_LINE = 100_000
"""Characters; the parser of cells takes no longer ones."""
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")


def read_csv(path: Path) -> MeasuredTable:
    """Read a file; an empty cell is NaN. Raise ImportRefused with the line that is not a table row.

    If commas do not separate the cells, a comma within a cell is a decimal comma.
    """
    try:
        with path.open("rb") as begin:
            encoding = "utf-16" if begin.read(2) in _UTF_16 else "utf-8-sig"
        with path.open(encoding=encoding) as file:
            return build_table(path, _split_lines(_number_lines(path, file)))
    except OSError as error:
        raise ImportRefused(f"cannot read {path}: {error.strerror}") from error
    except UnicodeError as error:
        detail = "is not UTF-8 text; save it as such (Excel: CSV UTF-8)"
        raise ImportRefused(f"{path} {detail}") from error


def _number_lines(path: Path, file: TextIO) -> Iterator[tuple[int, str]]:
    """Return the lines that are not empty, each with its number.

    Excel leaves lines of empty cells below a table, and may write `sep=;` above it.
    """
    number = 0
    while whole := file.readline(_LONGEST_LINE):
        number += 1
        if len(whole) == _LONGEST_LINE:
            detail = f"the line is longer than {_LONGEST_LINE} characters"
            raise ImportRefused(f"{path}:{number}: {detail}: is this a table of numbers?")
        line = whole.rstrip("\n")
        is_separator = number == 1 and line.lower().startswith("sep=") and len(line.strip()) == 5
        if line.strip(_EMPTY) and not is_separator and not line.lstrip().startswith(_COMMENTS):
            yield number, line


def _split_lines(lines: Iterator[tuple[int, str]]) -> Iterator[Row]:
    """Return the rows of cells, with decimal points: where commas do not separate, they are so."""
    head = list(islice(lines, HEAD_ROWS))
    delimiter = _choose_delimiter([line for _, line in head])
    for number, line in chain(head, lines):
        yield Row(number, _split_cells(line, delimiter))


def _choose_delimiter(head: Sequence[str]) -> str:
    """Return the mark that makes rows of numbers; without such rows, the first line's."""
    for delimiter in (*_DELIMITERS, _SPACES):
        if find_data([_split_cells(line, delimiter) for line in head]) is not None:
            return delimiter
    return next((mark for mark in _DELIMITERS if head and mark in head[0]), _SPACES)


def _split_cells(line: str, delimiter: str) -> list[str]:
    words = delimiter == _SPACES
    cells = line.split() if words else next(csv.reader([line], delimiter=delimiter))
    return cells if delimiter == "," else [_write_point(cell) for cell in cells]


def _write_point(cell: str) -> str:
    """Return a number with a decimal point; words keep their commas."""
    return cell.replace(",", ".") if "," in cell and cell.strip(" +-0123456789eE,") == "" else cell
