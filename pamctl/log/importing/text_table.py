"""Read a file of text: its encoding, its lines, the mark between its cells.

What holds for the whole file is decided once, from its first rows. Rows of plain numbers go to
numpy's reader; all others are read cell by cell, and what is wrong is named with line and cell.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from io import TextIOWrapper
from itertools import chain, islice
from pathlib import Path
from typing import BinaryIO, NamedTuple, TextIO

import numpy as np

from pamctl.log.importing.cell_texts import tell_kind
from pamctl.log.importing.column_map import TextHints
from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable
from pamctl.log.importing.table_rows import (
    HEAD_ROWS,
    Row,
    TableBuilder,
    TableLayout,
    find_layout,
)

WIDE_GAP = "two spaces or more"
_LONGEST_LINE = 100_000
"""Characters; the parser of cells takes no longer ones."""
_BLOCK = 1 << 18
_DELIMITERS = {"\t": "tab", ";": "semicolon", "|": "|", ",": "comma", WIDE_GAP: WIDE_GAP,
               " ": "spaces"}  # fmt: skip
_COMMENT = re.compile(r"\s*(?:#+|%+|//+|!)\s*")
_SPECIAL = ('"', "#", "%", "!", "//")
"""What lines may have that are no plain rows: a cell in quotes, a comment."""
_BOMS = ((b"\xff\xfe\0\0", "utf-32"), (b"\0\0\xfe\xff", "utf-32"), (b"\xef\xbb\xbf", "utf-8-sig"),
         (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))  # fmt: skip


class TextBlock(NamedTuple):
    """Some lines of a file, without their ends."""

    first: int
    text: str
    is_cut: bool = False
    """For the last line alone, where nothing ends it."""

    @property
    def lines(self) -> list[str]:
        """All of them."""
        return self.text.split("\n")


def read_text(path: Path, hints: TextHints, open_file: Callable[[], BinaryIO]) -> MeasuredTable:
    """Read a file of text; raise ImportRefused with the line and the cell that has no reading."""
    encoding, notes = _find_encoding(path, hints.encoding or "", open_file)
    with TextIOWrapper(open_file(), encoding) as file:
        try:
            delimiter, table = _read_blocks(path, _split_blocks(path, file), hints)
        except csv.Error as error:
            raise ImportRefused(f"{path} has a cell that has no end: {error}") from None
    plain = "utf-8" if encoding == "utf-8-sig" else encoding
    form = f"text in {plain}, {_DELIMITERS[delimiter]} between cells"
    return table.finish(form, notes)


def _read_blocks(
    path: Path, blocks: Iterator[TextBlock], hints: TextHints
) -> tuple[str, TableBuilder]:
    begun = list(islice(blocks, 2))  # the second one may be the last line of a short file
    first = begun[0] if begun else TextBlock(1, "")
    head = TextBlock(1, "\n".join([line for one in begun for line in one.lines][: 2 * HEAD_ROWS]))
    delimiter, layout = _choose_delimiter(path, head)
    builder = TableBuilder(path, layout, hints)
    skipped = next((row.number for row in list(_split_rows(head, delimiter))[layout.first :]), 1)
    below = first.text.split("\n", skipped - 1)
    begun[:1] = [TextBlock(skipped, below[-1], first.is_cut)] if len(below) == skipped else []
    for block in chain(begun, blocks):
        text = _unquote(block.text, delimiter)
        if not block.is_cut and builder.take_plain(block.first, text, delimiter):
            continue
        columns = _split_evenly(text, delimiter, len(layout.kinds))
        if columns is None:
            builder.take_rows(_split_rows(block, delimiter), is_cut=block.is_cut)
        else:
            lines = block.first + np.arange(len(columns[0]))
            builder.take(lines, columns, is_cut=block.is_cut)
    return delimiter, builder


def _unquote(text: str, delimiter: str) -> str:
    """Return lines without the quotes where all cells have them, and no mark within."""
    marks = (text.count(delimiter), text.count("\n"))
    is_whole = text[:1] == text[-1:] == '"' and text.count('"') == 2 * (sum(marks) + 1)
    is_whole = is_whole and marks == (text.count(f'"{delimiter}"'), text.count('"\n"'))
    return text.replace('"', "") if is_whole else text


def _split_evenly(text: str, delimiter: str, width: int) -> list[list[str]] | None:
    """Return the cells by column; None where a line has another number of cells, or quotes."""
    if delimiter in (" ", WIDE_GAP) or width == 1 or any(mark in text for mark in _SPECIAL):
        return None
    count = text.count("\n") + 1
    cells = text.replace("\n", f"{delimiter}\n").split(delimiter)
    there = len(cells) // count
    if there < width or len(cells) != there * count:
        return None
    first = "".join(cells[::there]).split("\n")  # all line breaks, if the lines are even
    is_even = len(first) == count and all(
        not "".join(cells[at::there]).strip() for at in range(width, there)
    )
    return [first, *(cells[at::there] for at in range(1, width))] if is_even else None


def _find_encoding(
    path: Path, stated: str, open_file: Callable[[], BinaryIO]
) -> tuple[str, list[str]]:
    with open_file() as file:
        begin = file.read(4)
    encoding = stated or next((name for bom, name in _BOMS if begin.startswith(bom)), "")
    if not encoding and len(begin) > 3 and begin[0] and begin[1::2] == b"\0\0":
        encoding = "utf-16-le"
    if encoding in ("", "utf-8"):
        with open_file() as file:
            if all(part.isascii() for part in iter(lambda: file.read(_BLOCK), b"")):
                return "utf-8", []
    for name in (encoding,) if encoding else ("utf-8", "cp1252"):
        try:
            with TextIOWrapper(open_file(), name) as text:
                while text.read(_BLOCK):
                    pass
        except LookupError:
            raise ImportRefused(f"there is no encoding {name!r}; try utf-8 or cp1252") from None
        except UnicodeError:
            continue
        told = (
            "the text is not UTF-8; it is read as Windows-1252 (Western Europe), which concerns "
            "names and units, not numbers; if they look wrong, say `encoding: NAME` in the map"
        )
        return name, [told] if name == "cp1252" and not encoding else []
    tried = encoding or "UTF-8 or Windows-1252"
    raise ImportRefused(f"{path} is no text in {tried}; say `encoding: NAME` in the map")


def _split_blocks(path: Path, file: TextIO) -> Iterator[TextBlock]:
    """Yield the lines in blocks, the last line alone where nothing ends it."""
    number, rest = 1, ""
    while text := file.read(_BLOCK):
        text = rest + text
        whole, end, rest = text.rpartition("\n")
        count = whole.count("\n") + len(end)
        if len(text) > 1000 * count:  # else no line can be that long but a few
            for at, line in enumerate(text.split("\n"), number):
                if len(line) > _LONGEST_LINE:
                    detail = f"the line is longer than {_LONGEST_LINE} characters"
                    raise ImportRefused(f"{path}:{at}: {detail}: is this a table of numbers?")
        while '"' in whole and sum(x.count('"') for x in whole.rsplit("\n", 50)[-50:]) % 2:
            whole, end, line = whole.rpartition("\n")  # a cell goes on in the next block
            rest = f"{line}\n{rest}"
            count -= 1
        if end:
            yield TextBlock(number, whole)
        number += count
    if rest.strip():
        yield TextBlock(number, rest, is_cut=True)


def _split_rows(block: TextBlock, delimiter: str) -> Iterator[Row]:
    """Yield the rows that are not empty; a quoted cell may hold line breaks."""
    if delimiter in (" ", WIDE_GAP):
        wide = re.compile(r"\s{2,}|\t")
        for number, line in enumerate(block.lines, block.first):
            comment = _match_comment(line, line.split(maxsplit=1))
            text = line[comment.end() :] if comment else line.strip()
            if text:
                cells = text.split() if delimiter == " " else wide.split(text)
                yield Row(number, cells, comment is not None)
        return
    reader = csv.reader(block.lines, delimiter=delimiter, skipinitialspace=delimiter != "\t")
    number = block.first
    for cells in reader:
        begun, number = number, block.first + reader.line_num
        comment = _match_comment(cells[0], cells) if cells else None
        if comment:
            cells[0] = cells[0][comment.end() :].strip('"')
        is_separator = begun == 1 and cells[:1] and cells[0].lower().startswith("sep=")
        if any(map(str.strip, cells)) and not is_separator:
            yield Row(begun, cells, comment is not None)


def _match_comment(text: str, cells: Sequence[str]) -> re.Match[str] | None:
    """Return the mark of a comment; None for a row that begins with a word such as `#N/A`."""
    comment = _COMMENT.match(text)
    return None if comment and tell_kind(cells[0]) == "m" else comment


def _choose_delimiter(path: Path, head: TextBlock) -> tuple[str, TableLayout]:
    """Return the mark that makes the most cells of the table numbers or times."""
    best: tuple[float, str, TableLayout] | None = None
    for delimiter in _DELIMITERS:
        try:
            rows = list(islice(_split_rows(head, delimiter), HEAD_ROWS))
        except csv.Error:
            continue
        layout = find_layout(rows)
        if layout is None:
            continue
        numeric = sum(kind in "nt" for kind in layout.kinds)
        is_named = not all(map(str.isdecimal, layout.names))
        score = numeric / len(layout.kinds) + (numeric > 1) + 0.1 * is_named
        if best is None or score > best[0]:
            best = score, delimiter, layout
    if best is None:
        first = next((line for line in head.lines if line.strip()), "")
        if not first:
            raise ImportRefused(f"{path} is empty")
        raise ImportRefused(
            f"{path} holds no rows of numbers within its first {HEAD_ROWS} lines; "
            f"it begins with {first[:60]!r}"
        )
    return best[1], best[2]
