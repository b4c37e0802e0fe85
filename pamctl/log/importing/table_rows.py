"""Find the table in rows of cells, and take its rows: names, units, numbers, what is wrong.

Bench 3; Mon 4 May            left out: no part of the table
# Time; Pressure; Position    names, also behind a comment mark
s; bar; mm                    units, if there is such a line
0,000; 1,013; 0,00            the first row of numbers
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pamctl.json_text import to_json
from pamctl.log.importing.cell_texts import (
    MISSING,
    OTHER,
    ClockColumn,
    DecimalMark,
    read_number,
    tell_kind,
)
from pamctl.log.importing.column_roles import read_unit
from pamctl.log.importing.measured_table import (
    MOST_NUMBERS,
    Floats,
    ImportRefused,
    Ints,
    MeasuredTable,
    TableColumn,
)
from pamctl.log.importing.quantities import TextHints

Cell = str | float
WIDE_GAP = "two spaces or more"
HEAD_ROWS = 200
"""The numbers begin within as many rows."""
_MOST_LEFT_OUT = 3
"""Lines below the table that are no rows of it, and may be left out."""


class Row(NamedTuple):
    """One row of a file."""

    number: int
    """In the file, from 1."""
    cells: Sequence[Cell]
    is_comment: bool = False


class TextBlock(NamedTuple):
    """Some lines of a file, without their ends."""

    first: int
    lines: list[str]
    is_cut: bool = False
    """For the last line alone, where nothing ends it."""


class TableLayout(NamedTuple):
    """What the first rows of a table say of it."""

    names: list[str]
    units: list[str]
    kinds: str
    """Of each column, as `tell_kind` says."""
    first: int
    """Index of the first row of numbers."""
    odd_names: str = ""
    """What stands above the numbers but does not fit to them."""


def find_layout(rows: Sequence[Row]) -> TableLayout | None:
    """Find names, units and numbers in the first rows of a table; None without numbers."""
    plain = [(index, row) for index, row in enumerate(rows) if not row.is_comment]
    body = [row.cells for _, row in plain[len(plain) // 2 :]]
    if not body:
        return None
    widths = Counter(len(cells) for cells in body)
    usual = max(widths, key=lambda width: (widths[width], width))
    body = [cells for cells in body if len(cells) == usual]
    width = max(_filled_width(row.cells) for row in rows if len(row.cells) <= usual)
    kinds = ""
    for at in range(width):
        seen = Counter(tell_kind(cells[at]) if at < len(cells) else "m" for cells in body)
        seen.pop("m", None)
        kinds += max(seen, key=lambda kind: (seen[kind], "wdtn".index(kind))) if seen else "m"
    if not set(kinds) & set("nt"):
        return None
    flags = [_is_data(row.cells, kinds) for _, row in plain]
    for at, (first, _) in enumerate(plain):
        after = [row for (_, row), good in zip(plain[at:], flags[at:], strict=True) if not good]
        near = {row.number for _, row in plain[at : at + 6]}
        # Numbers above the line of names are not the table's.
        above = after and after[0].number in near and _has_no_number(after[0].cells)
        if flags[at] and (not above or at + 1 == len(plain)):
            names, units = _find_names(rows[:first], width)
            above = [row for row in rows[:first] if not row.is_comment][-1:]
            odd = ""
            if above and names[0] == "1" and len(above[0].cells) > 1:
                count = _filled_width(above[0].cells)
                odd = f"line {above[0].number} has {count} cells, but the rows below have {width}"
            return TableLayout(names, units, kinds, first, odd)
    return None


def _filled_width(cells: Sequence[Cell]) -> int:
    return max((at for at, cell in enumerate(cells, 1) if str(cell).strip()), default=0)


def _is_data(cells: Sequence[Cell], kinds: str) -> bool:
    """Return whether more than half of the cells that should be numbers or times are so."""
    seen = [(tell_kind(cells[at]), kind) for at, kind in enumerate(kinds) if at < len(cells)]
    numeric = [(is_, kind) for is_, kind in seen if kind in "ntd"]
    good = sum(is_ in (kind, "m") for is_, kind in numeric)
    return 2 * good > sum(kind in "ntd" for kind in kinds) and any(i in "nt" for i, _ in numeric)


def _has_no_number(cells: Sequence[Cell]) -> bool:
    return not any(tell_kind(cell) in "nt" for cell in cells)


def _find_names(above: Sequence[Row], width: int) -> tuple[list[str], list[str]]:
    """Return the names and the units that stand above the numbers; numbers for names without."""
    names: list[str] | None = None
    units = [""] * width
    for row in reversed(above[-6:]):
        fits = len(row.cells) >= width >= _filled_width(row.cells)
        if not fits or (row.is_comment and len(row.cells) != width):
            if row.is_comment:
                continue
            break
        cells = [" ".join(str(cell).split()) for cell in row.cells[:width]]
        if not any(units) and _are_units(cells):
            units = [cell if _may_be_unit(cell) else "" for cell in cells]
        elif _has_no_number([cell for cell in cells if cell]) and any(cells):
            names = cells
            break
        elif not row.is_comment:
            break
    names = names or [""] * width
    return [name or str(number) for number, name in enumerate(names, 1)], units


def _are_units(cells: Sequence[str]) -> bool:
    stated = [cell for cell in cells if cell.strip("[]()- ")]
    return bool(stated) and 2 * sum(map(_may_be_unit, stated)) >= len(stated)


def _may_be_unit(cell: str) -> bool:
    return bool(cell) and (read_unit(cell) is not None or cell[0] + cell[-1] in ("[]", "()"))


class TableBuilder:
    """Takes the rows of a table, and says of each column what was not a number."""

    def __init__(
        self, path: Path, layout: TableLayout, hints: TextHints, delimiter: str = ""
    ) -> None:
        self._path, self._layout, self._delimiter, self._hints = path, layout, delimiter, hints
        self._width = len(layout.kinds)
        self._plain = [at for at, kind in enumerate(layout.kinds) if kind in "nm"]
        self._clocks = {at: ClockColumn() for at, kind in enumerate(layout.kinds) if kind in "td"}
        self._missing = MISSING | {word.lower() for word in hints.missing}
        self._sentinels = [n for w in hints.missing if (n := read_number(w, ".")) is not None]
        self._mark = DecimalMark(hints.decimal)
        self._parts: list[Floats] = []
        self._lines: list[Ints] = []
        self._bad: dict[int, tuple[str, str]] = {}
        self._words: dict[int, str] = {}
        self._odd: list[tuple[int, str]] = []
        self._comments: list[int] = []
        self._rows = 0
        self._remarks: list[str] = []
        self._doubt = ""

    def look_for_mark(self, rows: Iterable[Row], fewest: int = 0) -> None:
        """Show cells to the decimal mark's decision, at least those of the first rows."""
        for count, row in enumerate(rows):
            for at, kind in enumerate(self._layout.kinds):
                if kind == "w" and at < len(row.cells) and not count:
                    self._words[at] = f"{row.cells[at]!r} in line {row.number}"
            if count >= fewest and self._mark.is_proved:
                return
            for at in self._plain:
                if at < len(row.cells) and not row.is_comment:
                    self._mark.take(row.number, row.cells[at])

    def _decimal(self) -> str:
        try:
            return self._mark.settle()
        except ValueError as error:
            self._doubt = f"{self._path}: {error}"
            return "."

    def take_numbers(self, block: TextBlock) -> bool:
        """Take a block of plain numbers, and of times beside them; return False for any other."""
        text = "\n".join(block.lines)
        delimiter = None if self._delimiter == " " else self._delimiter
        marks = {".", ","} - {self._delimiter}
        if block.is_cut or self._delimiter == WIDE_GAP:
            return False
        if '"' in text:
            text = self._unquote(text, len(block.lines))
            if not text:
                return False
        if not self._mark.is_proved and any(mark in text for mark in marks):
            return False
        decimal = self._decimal()
        if OTHER[decimal] in text and OTHER[decimal] != self._delimiter:
            return False
        text = text.replace(",", ".") if decimal == "," else text
        lines = text.split("\n")
        load = partial(np.loadtxt, delimiter=delimiter, comments=None, ndmin=2)
        try:
            if len(self._plain) == self._width:
                table = load(lines)
                if table.shape != (len(lines), self._width):
                    return False
            else:
                cells = [line.split(delimiter) for line in lines]
                if any(len(row) != self._width for row in cells):
                    return False
                table = load(lines, usecols=self._plain)
                if len(table) != len(lines) or not self._plain:
                    return False
                for at, clock in self._clocks.items():
                    begun = len(clock)
                    if not clock.take_many([row[at] for row in cells]):
                        for one in self._clocks.values():
                            one.forget(begun)
                        return False
        except ValueError:
            return False
        self._add(table, np.arange(block.first, block.first + len(lines)))
        return True

    def _unquote(self, text: str, lines: int) -> str:
        """Return lines whose cells are all quoted without the quotes; nothing for any other."""
        apart = text.count(f'"{self._delimiter}"')
        is_whole = apart == text.count(self._delimiter) == lines * (self._width - 1)
        is_whole = is_whole and text.count('"') == 2 * lines * self._width
        return text.replace('"', "") if is_whole else ""

    def take_rows(self, rows: Iterable[Row], *, is_cut: bool = False) -> None:
        """Take rows cell by cell. `is_cut`: nothing ends the last one, which may be cut off."""
        rows = list(rows)
        if not self._mark.is_proved:
            self.look_for_mark(rows)
        decimal = self._decimal()
        numbers, lines = [], []
        for row in rows:
            if row.is_comment:
                self._comments.append(row.number)
                continue
            why = self._find_oddity(row, decimal, is_cut=is_cut)
            if why:
                self._odd.append((row.number, why))
                continue
            self._refuse_odd()
            numbers.append([self._read(row, at, decimal) for at in self._plain])
            for at, clock in self._clocks.items():
                if tell_kind(row.cells[at], self._missing) == "m":
                    clock.skip()
                elif not clock.take(row.cells[at]):
                    self._complain(row, at)
                    clock.skip()
            lines.append(row.number)
        if numbers:
            self._add(np.array(numbers, np.float64).reshape(len(lines), -1), np.array(lines))

    def _add(self, table: Floats, lines: Ints) -> None:
        self._parts.append(table)
        self._lines.append(lines)
        self._rows += len(lines)
        if self._rows * self._width > MOST_NUMBERS:
            detail = f"more than {MOST_NUMBERS:.0f} numbers up to line {lines[-1]}"
            raise ImportRefused(f"{self._path} is too large: {detail}; cut it into parts")

    def _find_oddity(self, row: Row, decimal: str, *, is_cut: bool) -> str:
        """Return why a row is none of the table; nothing for one that is."""
        if not len(row.cells) >= self._width >= _filled_width(row.cells):
            there = max(_filled_width(row.cells), min(len(row.cells), self._width))
            return f"the line has {there} cells, but the table has {self._width}"
        if [str(cell).strip() for cell in row.cells[: self._width]] == self._layout.names:
            return "the names are repeated: a second table begins; save it as a file of its own"
        numeric = [row.cells[at] for at in (*self._plain, *self._clocks)]
        if all(tell_kind(cell, self._missing) in "wm" for cell in numeric) and any(
            tell_kind(cell, self._missing) == "w" for cell in numeric
        ):
            return "no cell is a number"
        if is_cut and any(
            tell_kind(row.cells[at], self._missing) != "m"
            and read_number(row.cells[at], decimal) is None
            for at in self._plain
        ):
            return "the last cell is cut off"
        if is_cut:
            self._remarks.append(
                f"nothing ends line {row.number}, the last one: if the file was cut off there, "
                f"its last cell {row.cells[self._width - 1]!r} may lack digits"
            )
        return ""

    def _refuse_odd(self) -> None:
        if self._odd:
            number, why = self._odd[0]
            raise ImportRefused(f"{self._path}:{number}: {why}")

    def _read(self, row: Row, at: int, decimal: str) -> float:
        cell = row.cells[at]
        value = read_number(cell, decimal)
        if value is None:
            if str(cell).strip().lower() not in self._missing:
                self._complain(row, at)
            return np.nan
        return value

    def _complain(self, row: Row, at: int) -> None:
        if at in self._bad:
            return
        name, cell = self._layout.names[at], str(row.cells[at]).strip()
        must = f"a time as {self._clocks[at].first!r}" if at in self._clocks else "a number"
        self._bad[at] = (
            f"{self._path}:{row.number}: {name} is {cell!r}, but must be {must}; if that means a "
            "missing value, say so in the map",
            f"missing: [{to_json(cell).decode()}]",
        )

    def finish(self, form: str, notes: Sequence[str] = ()) -> MeasuredTable:
        """Return the table; raise ImportRefused where too much below it is no part of it."""
        if len(self._odd) > _MOST_LEFT_OUT:
            self._refuse_odd()
        notes = [*notes, *([self._layout.odd_names] if self._layout.odd_names else [])]
        notes += [f"line {number} is left out: {why}" for number, why in self._odd]
        if self._comments:
            notes.append(
                f"{len(self._comments)} comment lines are left out, the first is line "
                f"{self._comments[0]}"
            )
        lines = np.concatenate(self._lines) if self._lines else np.zeros(0, np.int64)
        columns = []
        dates = [c for c in self._clocks.values() if c.form is not None and c.form[1] == "date"]
        for at, (name, unit, kind) in enumerate(zip(*self._layout[:3], strict=True)):
            if at in self._clocks:
                columns.append(self._finish_clock(at, name, dates))
                continue
            if kind == "w":
                says = f"words, no numbers: {self._words.get(at, '')}"
                columns.append(TableColumn(name, np.zeros(0), unit, is_text=True, says=says))
                continue
            index = self._plain.index(at)
            values = np.concatenate([part[:, index] for part in self._parts] or [np.zeros(0)])
            values[np.isin(values, self._sentinels)] = np.nan
            bad, mend = self._bad.get(at, ("", ""))
            columns.append(TableColumn(name, values, unit, bad_cell=bad, mend=mend))
        decimal = "decimal comma" if self._decimal() == "," else "decimal point"
        form = f"{form}, {decimal}"
        mend = "decimal: '.'  # or ','" if self._doubt else ""
        rows = lines.astype(np.int64)
        return MeasuredTable(columns, rows, form, notes, self._remarks, self._doubt, mend)

    def _finish_clock(self, at: int, name: str, dates: Sequence[ClockColumn]) -> TableColumn:
        clock = self._clocks[at]
        bad, mend = self._bad.get(at, ("", ""))
        beside = None
        if len(dates) == 1 and clock.form and not clock.form[0] and dates[0].changes:
            beside = dates[0]
        if clock in dates:
            return TableColumn(name, np.zeros(0), is_text=True, says="dates; the times count them")
        try:
            values = clock.finish(self._hints.date_order, beside)
        except ValueError as error:
            bad = bad or f"{self._path}: {name}: {error}"
            mend = "date_order: d/m/y  # or m/d/y" if "day from month" in bad else ""
            values = np.full(len(clock), np.nan)
        says = "times of day, in seconds"
        return TableColumn(name, values, "s", bad_cell=bad, mend=mend, says=says)
