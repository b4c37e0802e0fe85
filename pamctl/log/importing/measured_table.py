"""A measured file as a table: columns of numbers, and what must be said of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.base.texts import hint_at_nearest
from pamctl.log.framing import LogError
from pamctl.log.importing.headers import Header, read_header

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class ImportRefused(LogError):
    """A measured file cannot be imported. The message says what, where, and what to do."""


class MapWanted(ImportRefused):
    """What a column holds is not clear, and a map can say it. The message shows one."""


MOST_NUMBERS = 250_000_000
"""2 GB as floats."""
TIME_S = "time_s"
"""What the time is called where a format has it apart from its columns, in seconds."""


@dataclass(frozen=True, eq=False)
class TableColumn:
    """A column of a file."""

    name: str
    values: Floats
    """Shape (n,); NaN where nothing was measured. Empty for a column without numbers."""
    unit: str = ""
    """Stated apart from the name, as in a line below the names; `s` for times of day."""
    called: str = ""
    """The label of a Simulink signal: a second name."""
    is_text: bool = False
    says: str = ""
    """What a reader of the report must know, such as which cells are missing."""
    bad_cell: str = ""
    """The first cell that is no number, with its line; such a column cannot be used."""
    mend: Mapping[str, Any] = field(default_factory=dict)
    """The keys of a map that may mend that."""

    @property
    def header(self) -> Header:
        """What its names and its unit say."""
        return read_header(self.name, self.called, self.unit)


@dataclass(frozen=True)
class MeasuredTable:
    """The columns of a file in their order, and the numbers of the rows in the file."""

    columns: Sequence[TableColumn]
    rows: Ints
    """Number of each row in the file: the line of a text, the index from 1 in a MAT file."""
    form: str = ""
    """How the file was read: its format, and what was decided for the whole file."""
    notes: Sequence[str] = field(default=())
    """What the user must know of the file, such as that its end is missing."""
    remarks: Sequence[str] = field(default=())
    """What may be wrong with it, but most often is not."""
    doubt: str = ""
    """What is not clear of the whole file; such a table cannot be used."""
    mend: Mapping[str, Any] = field(default_factory=dict)
    """The keys of a map that may mend that."""

    def find(self, wanted: str | int) -> TableColumn:
        """Return a column by its name, its number from 1, or `name(2,:)` for a row of a matrix.

        Raise ImportRefused with the existing names if there is none, or more than one.
        """
        if isinstance(wanted, str):
            found = [column for column in self.columns if column.name == wanted.strip()]
            if len(found) > 1 and not all(_are_same(found[0], other) for other in found[1:]):
                numbers = [n for n, c in enumerate(self.columns, 1) if c.name == wanted.strip()]
                raise ImportRefused(
                    f"{len(found)} columns are called {wanted!r}; say which by its number: "
                    f"{' or '.join(f'column: {number}' for number in numbers)}"
                )
            if found:
                return found[0]
        text = str(wanted)
        if text.isdecimal() and 1 <= int(text) <= len(self.columns):
            return self.columns[int(text) - 1]
        names = list(dict.fromkeys(column.name for column in self.columns))
        hint = hint_at_nearest(text, names)
        listed = ", ".join(names[:20]) or "none"
        why = f"there is no column {wanted!r}{hint}; there are {listed}"
        raise ImportRefused("; ".join([why, *self.notes]))

    def number_of(self, column: TableColumn) -> int:
        """Return the number of a column, from 1."""
        return self.columns.index(column) + 1

    def name_of(self, column: TableColumn) -> str | int:
        """Return how a map names a column: by its number where its name does not tell."""
        is_one = sum(one.name == column.name for one in self.columns) == 1
        is_clear = column.name == column.name.strip() and column.name.isprintable()
        return column.name if is_one and is_clear and column.name else self.number_of(column)


def _are_same(one: TableColumn, other: TableColumn) -> bool:
    return one.unit == other.unit and np.array_equal(one.values, other.values, equal_nan=True)


def make_columns(
    arrays: Mapping[str, Floats] | Iterable[tuple[str, Floats]],
    units: Mapping[str, str] | None = None,
) -> list[TableColumn]:
    """Return columns of arrays of shape (n,) by name; a two-dimensional one is taken apart.

    `yout(:,2)` is the second column of a matrix that is higher than wide, `yout(2,:)` the second
    row of one that is wider.
    """
    units = units or {}
    found = []
    for name, values in arrays.items() if isinstance(arrays, Mapping) else arrays:
        unit = units.get(name, "")
        if values.ndim < 2 or 1 in values.shape:
            found.append(TableColumn(name, values.reshape(-1).astype(np.float64), unit))
        elif values.ndim == 2 and values.size:
            wide = values.shape[1] > values.shape[0]
            for index, row in enumerate(values if wide else values.T, 1):
                place = f"({index},:)" if wide else f"(:,{index})"
                found.append(TableColumn(name + place, row.astype(np.float64), unit))
    return found


BOMB_BYTES = 512 << 20
BOMB_RATIO = 20
"""A file that unpacks to more bytes, and to so many times its size, is no measurement."""


def refuse_bomb(path: Path, unpacked: int) -> None:
    """Raise ImportRefused for a file whose container declares far more than its size."""
    if unpacked > max(BOMB_BYTES, BOMB_RATIO * path.stat().st_size):
        size = f"{unpacked / 2**30:.1f} GB unpacked"
        raise ImportRefused(f"{path} is too large: {size}; save a part of it, or as CSV")


def number_rows(columns: list[TableColumn], form: str, notes: list[str]) -> MeasuredTable:
    """Return the table of columns that have no lines: their rows count from 1."""
    longest = max((len(column.values) for column in columns), default=0)
    return MeasuredTable(columns, np.arange(1, longest + 1), form, notes)
