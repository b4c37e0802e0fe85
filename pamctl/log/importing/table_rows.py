"""Find the table in rows of cells, and take its rows: names, units, numbers, what is wrong.

Bench 3; Mon 4 May            left out: no part of the table
# Time; Pressure; Position    names, also behind a comment mark
s; bar; mm                    units, if there is such a line
0,000; 1,013; 0,00            the first row of numbers
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pamctl.base.texts import count_of
from pamctl.log.importing.cell_texts import (
    MISSING,
    Cell,
    ClockColumn,
    DecimalMark,
    read_number,
    read_numbers,
    read_plain_rows,
    tell_kind,
)
from pamctl.log.importing.column_map import TextHints
from pamctl.log.importing.headers import read_unit
from pamctl.log.importing.measured_table import (
    MOST_NUMBERS,
    Floats,
    ImportRefused,
    Ints,
    MeasuredTable,
    TableColumn,
)

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
        # Numbers above the line of names are not the table's.
        near = zip(plain[at : at + 6], flags[at : at + 6], strict=True)
        below = next((row for (_, row), is_good in near if not is_good), None)
        if flags[at] and (below is None or not _has_no_number(below.cells)):
            names, units = _find_names(rows[:first], width)
            above, odd = plain[at - 1][1] if at else Row(0, []), ""
            count = _filled_width(above.cells)
            if names[0] == "1" and len(above.cells) > 1 and count != width:
                odd = f"line {above.number} has {count_of(count, 'cell')}, those below {width}"
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
        filled = _filled_width(row.cells)
        fits = len(row.cells) >= width >= filled
        if not fits or (row.is_comment and width not in (filled, len(row.cells))):
            if row.is_comment:
                continue
            break
        cells = [" ".join(str(cell).split()) for cell in row.cells[:width]]
        if all(tell_kind(cell) == "m" for cell in cells):
            continue
        stated = [cell for cell in cells if cell.strip("[]()- ")]
        are_units = bool(stated) and 2 * sum(map(_may_be_unit, stated)) >= len(stated)
        if not any(units) and are_units:
            units = [cell if cell in stated else "" for cell in cells]
        elif _has_no_number(cells):
            names = cells
            break
        elif not row.is_comment:
            break
    names = names or [""] * width
    return [name or str(number) for number, name in enumerate(names, 1)], units


def _may_be_unit(cell: str) -> bool:
    return bool(cell) and (read_unit(cell) is not None or cell[0] + cell[-1] in ("[]", "()"))


class TableBuilder:
    """Takes the rows of a table, and says of each column what was not a number."""

    def __init__(self, path: Path, layout: TableLayout, hints: TextHints) -> None:
        self._path, self._layout, self._hints = path, layout, hints
        self._width = len(layout.kinds)
        self._plain = [at for at, kind in enumerate(layout.kinds) if kind in "nm"]
        self._clocks = {at: ClockColumn() for at, kind in enumerate(layout.kinds) if kind in "td"}
        self._parts: dict[int, list[Floats]] = {at: [] for at in (*self._plain, *self._clocks)}
        self._lines: list[Ints] = []
        self._missing = MISSING | {word.lower() for word in hints.missing}
        self._mark = DecimalMark(hints.decimal or "")
        self._bad: dict[int, tuple[str, dict[str, Any]]] = {}
        self._words: dict[int, str] = {}
        self._odd: dict[int, str] = {}
        self._comments: list[int] = []
        self._remarks: list[str] = []

    def take_rows(self, rows: Iterable[Row], *, is_cut: bool = False) -> None:
        """Take rows of any width. `is_cut`: nothing ends the last one, which may be cut off."""
        lines, cells = [], []
        for row in rows:
            there = len(row.cells)
            if row.is_comment:
                self._comments.append(row.number)
            elif there == self._width or there > self._width >= _filled_width(row.cells):
                lines.append(row.number)
                cells.append(row.cells[: self._width])
            else:
                there = max(_filled_width(row.cells), min(there, self._width))
                self._odd[row.number] = (
                    f"the line has {count_of(there, 'cell')}, but the table has {self._width}"
                )
        if lines:
            self.take(np.array(lines), list(zip(*cells, strict=True)), is_cut=is_cut)

    def take(self, lines: Ints, columns: Sequence[Sequence[Cell]], *, is_cut: bool = False) -> None:
        """Take the cells of each column, in rows of these lines."""
        for at, kind in enumerate(self._layout.kinds):
            if kind == "w":
                self._words.setdefault(at, f"{columns[at][0]!r} in line {lines[0]}")
        decimal = self._look_for_mark(lines, columns)
        read: dict[int, Floats] = {}
        bad: dict[int, list[int]] = {}
        for at in self._plain:
            read[at], bad[at] = read_numbers(columns[at], decimal, self._missing)
        for at, clock in self._clocks.items():
            read[at], bad[at] = clock.read(columns[at], self._missing)
        kept = np.ones(len(lines), bool)
        without = np.all(
            [np.isnan(part.reshape(len(lines), -1)[:, 0]) for part in read.values()], 0
        )
        for row in np.flatnonzero(without).tolist():
            cells = [str(column[row]).strip() for column in columns]
            is_odd = any(row in rows for rows in bad.values())
            kept[row] = not is_odd and any(cells)
            if is_odd:
                again = (
                    "the names are repeated: a second table begins; save it as a file of its own"
                )
                is_again = cells == self._layout.names
                self._odd[int(lines[row])] = again if is_again else "no cell is a number"
        if is_cut and kept.all():
            kept[0] = not any(bad.values())
            if kept[0]:
                self._remarks.append(
                    f"nothing ends line {lines[0]}, the last one: if the file was cut off there, "
                    f"its last cell {columns[-1][0]!r} may lack digits"
                )
            else:
                self._odd[int(lines[0])] = "the last cell is cut off"
        self._refuse_odd(before=int(lines[kept][-1]) if kept.any() else 0)
        for at, rows in bad.items():
            for row in rows:
                if kept[row] and at not in self._bad:
                    self._complain(at, int(lines[row]), str(columns[at][row]).strip())
        self._lines.append(lines[kept])
        for at, part in read.items():
            self._parts[at].append(part[kept])
        self._limit_size()

    def take_plain(self, first: int, text: str, delimiter: str) -> bool:
        """Take lines that hold plain numbers in all columns; return False for any other."""
        decimal = self._mark.choose()
        if len(self._plain) < self._width or not self._mark.is_proved:
            return False
        values = read_plain_rows(text, delimiter, decimal, self._width)
        if values is None:
            return False
        self._refuse_odd(before=first)
        self._lines.append(first + np.arange(len(values)))
        for at in self._plain:
            self._parts[at].append(values[:, at])
        self._limit_size()
        return True

    def _limit_size(self) -> None:
        if sum(map(len, self._lines)) * self._width > MOST_NUMBERS:
            detail = f"more than {MOST_NUMBERS:.0f} numbers up to line {self._lines[-1][-1]}"
            raise ImportRefused(f"{self._path} is too large: {detail}; cut it into parts")

    def _look_for_mark(self, lines: Ints, columns: Sequence[Sequence[Cell]]) -> str:
        """Return the decimal mark; one that shows too late, or twice, is refused at the end."""
        begin, rest = slice(0, HEAD_ROWS), slice(HEAD_ROWS, None)
        for part in (begin, rest):
            if not self._mark.is_proved or (part is begin and not self._lines):
                for at in self._plain:
                    self._mark.take(lines[part], columns[at][part])
        return self._mark.choose()

    def _refuse_odd(self, before: float) -> None:
        """Raise ImportRefused where a line before this one is no row of the table."""
        if self._odd and (number := min(self._odd)) < before:
            raise ImportRefused(
                f"{self._path}:{number}: {self._odd[number]}; complete the line, or delete it: "
                "its time is then a gap"
            )

    def _complain(self, at: int, line: int, cell: str) -> None:
        name = self._layout.names[at]
        must = f"a time as {self._clocks[at].first!r}" if at in self._clocks else "a number"
        self._bad[at] = (
            f"{self._path}:{line}: {name} is {cell!r}, but must be {must}; if that means a "
            "missing value, say so in the map",
            {"missing": [cell]},
        )

    def finish(self, form: str, remarks: Sequence[str] = ()) -> MeasuredTable:
        """Return the table; raise ImportRefused where too much below it is no part of it."""
        if len(self._odd) > _MOST_LEFT_OUT:
            self._refuse_odd(before=np.inf)
        notes = [self._layout.odd_names] if self._layout.odd_names else []
        notes += [f"line {number} is left out: {why}" for number, why in self._odd.items()]
        if self._comments:
            notes.append(
                f"left out: {count_of(len(self._comments), 'comment line')}, the first is line "
                f"{self._comments[0]}"
            )
        doubt = self._mark.doubt and f"{self._path}: {self._mark.doubt}"
        mend = {"decimal": self._mark.choose() if self._mark.is_proved else "."} if doubt else {}
        decimal = "decimal comma" if self._mark.choose() == "," else "decimal point"
        rows = np.concatenate(self._lines) if self._lines else np.zeros(0, np.int64)
        columns = list(self._finish_columns())
        remarks = [*remarks, *self._remarks]
        return MeasuredTable(columns, rows, f"{form}, {decimal}", notes, remarks, doubt, mend)

    def _finish_columns(self) -> Iterator[TableColumn]:
        sentinels = [n for w in self._hints.missing if (n := read_number(w, ".")) is not None]
        found = {at: np.concatenate(parts) for at, parts in self._parts.items() if parts}
        dates = [at for at, clock in self._clocks.items() if clock.is_date]
        order = self._hints.date_order or ""
        for at, (name, unit, kind) in enumerate(zip(*self._layout[:3], strict=True)):
            bad, mend = self._bad.get(at, ("", {}))
            if kind == "w":
                says = f"words, no numbers: {self._words.get(at, '')}"
                yield TableColumn(name, np.zeros(0), unit, is_text=True, says=says)
            elif at in dates:
                says = "dates; the times count them"
                yield TableColumn(name, np.zeros(0), is_text=True, says=says)
            elif at in self._clocks:
                times = found.get(at, np.zeros((0, 2)))
                try:
                    days = None
                    if len(dates) == 1 and np.ptp(found[dates[0]][:, 1]):
                        days = self._clocks[dates[0]].count_days(found[dates[0]], order)
                    values = self._clocks[at].finish(times, order, days)
                except ValueError as error:
                    bad = bad or f"{self._path}: {name}: {error}"
                    mend = {"date_order": "d/m/y"} if "day from month" in bad else mend
                    values = np.full(len(times), np.nan)
                says = "times of day, in seconds"
                yield TableColumn(name, values, "s", bad_cell=bad, mend=mend, says=says)
            else:
                values = found.get(at, np.zeros(0))
                values[np.isin(values, sentinels)] = np.nan
                yield TableColumn(name, values, unit, bad_cell=bad, mend=mend)
