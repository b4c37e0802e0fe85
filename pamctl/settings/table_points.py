"""The points of a table: a column of times and a column of values, in a CSV or a MAT file."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.base.new_file import describe_irregular_file
from pamctl.control.forms import MOST_ROWS
from pamctl.control.waves import Sampled
from pamctl.log.importing.column_roles import names_quantity
from pamctl.log.importing.file_formats import read_table
from pamctl.log.importing.headers import TIME, UNITS
from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable, TableColumn

Floats = NDArray[np.float64]

LARGEST_FILE = 50_000_000
_QUANTITIES = {"table": ("position_m", "mm"), "valve_table": ("valve_v", "V")}
_KEYS = {"table": "values_mm", "valve_table": "values_v"}


_BEYOND = 0.03
"""Share of the points' range by which their curve may leave it without a word."""
_LOOKS = (0.1, 0.25, 0.4, 0.6, 0.75, 0.9)
"""Where the curve is looked at, in shares of the time between two points."""


def read_points(table: dict[str, Any], path: Path) -> str:
    """Put the points of a file into the keys of its table; raise ValueError with the reason.

    Return what is doubtful of them; nothing where all is well.
    """
    try:
        _put_points(table, path)
    except ImportRefused as refusal:
        raise ValueError(str(refusal)) from refusal
    return _doubt_curve(table, path)


def _doubt_curve(table: dict[str, Any], path: Path) -> str:
    """Say where the curve leaves the range of its points, which corners make it do."""
    t_s, values = table["t_s"], table[_KEYS[table["kind"]]]
    curve, unit = Sampled(t_s, values), _QUANTITIES[table["kind"]][1]
    between = [curve.at(a + look * (b - a)).position_m for a, b in pairwise(t_s) for look in _LOOKS]
    low, high, beyond = min(values), max(values), _BEYOND * (max(values) - min(values))
    if low - beyond <= min(between) and max(between) <= high + beyond:
        return ""
    return (
        f"{path}: the curve through the points runs from {min(between):.4g} to "
        f"{max(between):.4g} {unit}, beyond the points' own {low:.4g} to {high:.4g} {unit}: add "
        "points beside the corners, or use `kind: ramps` for lines and holds"
    )


def _put_points(table: dict[str, Any], path: Path) -> None:
    columns = _read_columns(path)
    quantity, unit = _QUANTITIES[table["kind"]]
    found, lacks = [], []
    for wanted in (
        (TIME, table.get("time_column"), None),
        (quantity, table.get("value_column"), table.get("unit")),
    ):
        try:
            found.append(_choose_column(columns, *wanted))
        except _Unclear as unclear:
            lacks.append(str(unclear))
    if lacks:  # all at once
        listed = ", ".join(one.name for one in columns.columns)
        raise ValueError(f"{'; '.join(lacks)}; the columns are {listed}")
    time, value = found
    every = table.get("every", 1)
    step = every if isinstance(every, int) and every > 0 else 1
    t_s = _read_numbers(time[0]) * UNITS[TIME][time[1]]
    values = _read_numbers(value[0]) * (UNITS[quantity][value[1]] / UNITS[quantity][unit])
    if len(t_s) != len(values):
        raise ValueError(f"{path}: {len(t_s)} times, but {len(values)} values")
    _require_points(path, t_s, values, columns.rows)
    t_s, values = t_s[::step], values[::step]
    if len(t_s) > MOST_ROWS:
        enough = step * -(-len(t_s) // MOST_ROWS)
        raise ValueError(
            f"{path} has {len(t_s)} points, more than {MOST_ROWS}; take each n-th row with "
            f"every: {enough}"
        )
    # Nanoseconds and picometres: shorter in every log.
    table["t_s"] = [round(t, 9) for t in (t_s - t_s[0]).tolist()]
    table[_KEYS[table["kind"]]] = [round(v, 9) for v in values.tolist()]


def _read_columns(path: Path) -> MeasuredTable:
    irregular = describe_irregular_file(path)
    if irregular:
        raise ValueError(f"cannot read {path}: it is {irregular}")
    if path.suffix.lower() not in (".csv", ".mat"):
        raise ValueError(f"{path} is neither a .csv nor a .mat file")
    if path.is_file() and path.stat().st_size > LARGEST_FILE:
        size_mb = path.stat().st_size / 1e6
        raise ValueError(
            f"{path} has {size_mb:.0f} MB, more than {LARGEST_FILE / 1e6:.0f}; a table takes "
            f"{MOST_ROWS} points at most"
        )
    return read_table(path)


class _Unclear(ValueError):
    """A column that nothing names; the message says what to give."""


def _choose_column(
    table: MeasuredTable, quantity: str, wanted: str | None, unit: str | None
) -> tuple[TableColumn, str]:
    """Return the column of a quantity and its unit; raise `_Unclear` where it is not clear."""
    units, is_time = UNITS[quantity], quantity == TIME
    if unit is not None and unit not in units:
        raise _Unclear(f"the unit {unit!r} is none of {', '.join(units)}")
    found = [c for c in table.columns if names_quantity(c, quantity) and (c.header.unit or unit)]
    found = found if wanted is None else [table.find(wanted)]
    if len(found) != 1:
        what = "a time" if is_time else f"this quantity with its unit ({', '.join(units)})"
        how_many = "no column's name states" if not found else "more than one column's name states"
        give = "time_column" if is_time else "value_column"
        needs_unit = unit is None and not is_time and not found
        raise _Unclear(f"{how_many} {what}; give {give}{' and unit' if needs_unit else ''}")
    header = found[0].header
    said = unit or (header.unit if header.quantity == quantity else "") or "s" * is_time
    if not said:
        raise _Unclear(f"the name of {found[0].name!r} states no unit; give unit")
    return found[0], said


def _read_numbers(column: TableColumn) -> Floats:
    if column.bad_cell or column.is_text:
        raise ValueError(f"{column.bad_cell or column.name + ' holds words'}, but must be a number")
    return column.values


def _require_points(path: Path, t_s: Floats, values: Floats, rows: NDArray[np.int64]) -> None:
    if len(t_s) < 2:
        raise ValueError(f"{path} has {len(t_s)} row; a table needs two at least")
    bad = np.flatnonzero(~(np.isfinite(t_s) & np.isfinite(values)))
    if len(bad):
        raise ValueError(f"{path}:{rows[bad[0]]}: rows without a finite number: {len(bad)}")
    back = np.flatnonzero(np.diff(t_s) <= 0)
    if len(back):
        at = int(back[0]) + 1
        raise ValueError(
            f"{path}:{rows[at]}: time must rise, but {t_s[at]:g} s follows {t_s[at - 1]:g} s"
        )
