"""The map that a refusal of an import shows, with a line for each column that may be a quantity.

What must be filled in, or is one of several, is a comment: the map can be used as it stands.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pamctl.log.importing.column_map import KEYS, ValveMap, describe_part, quote, write_key
from pamctl.log.importing.command_range import doubt_command
from pamctl.log.importing.headers import CURRENTS, NAMES, TIME, UNITS, explain_angle, split_words
from pamctl.log.importing.measured_table import ImportRefused, MapWanted, MeasuredTable, TableColumn

NEVER_ABSOLUTE_PA = 80e3
"""An absolute pressure in a muscle does not fall so low."""
_EXAMPLES: Mapping[str, Mapping[str, Any]] = {
    "valve_v": {"unit": "V", "gain": 1.0, "offset": 0.0},
    "pressure_pa": {"unit": "kPa", "gauge": True},
    "position_m": {"unit": "mm"},
    "force_n": {"unit": "N", "gain": 1.0},
}


def refuse(
    table: MeasuredTable,
    doubts: Sequence[str],
    settled: Mapping[str, Mapping[str, Any]],
    found: Mapping[str, Sequence[TableColumn]],
) -> ImportRefused:
    """Return what is in doubt, with a map if a column may be what is missing.

    `settled` are keys by quantity, `found` the columns.
    """
    doubts = list(doubts)
    if TIME not in settled and not found[TIME]:
        names = ", ".join(dict.fromkeys(column.name for column in table.columns[:20]))
        if all(column.name.isdecimal() for column in table.columns):
            why = f"there is no line of names above the numbers: the columns are called {names}"
        else:
            such = "t_s, time_s, time_ms, `Time [s]` or the like, with the unit in its name"
            why = f"no column is called {such}; there are {names}"
        doubts.append(why)
    lines = []
    for quantity, named in found.items():
        usable = [column for column in named if not column.is_text]
        if quantity in settled:
            lines.append(
                _write_in_range(table.find(settled[quantity]["column"]), settled[quantity])
            )
        elif quantity == TIME and not any(column.header.unit for column in usable):
            lines.append(_propose_time(table, usable or table.columns))
        else:
            lines += [_propose(table, column, is_first=column is usable[0]) for column in usable]
    asked = [column for named in found.values() for column in named]
    rest = [column for column in table.columns if not (column in asked or column.is_text)]
    rest = [c for c in rest if not lines[0].startswith(f"time: {{column: {quote(c.name)},")]
    lines += _propose_others(table, rest, {q for q, named in found.items() if named})
    lines += [write_key(key, value) for key, value in table.mend.items()]
    why = "; ".join([*doubts, *table.notes])
    if all(line.startswith(("time:", "# other columns")) for line in lines):
        return ImportRefused(why)
    return MapWanted(show_map(f"{why}; say which with --map FILE, such as:", lines))


def propose_missing(table: MeasuredTable, used: Mapping[str, TableColumn]) -> list[str]:
    """Return lines of a map, as comments, for columns that may be what is not read yet."""
    rest = [
        column
        for column in table.columns
        if not (column in used.values() or column.is_text or column.header.others)
    ]
    return [*_propose_others(table, rest, {*used})]


def _propose_others(
    table: MeasuredTable, rest: Sequence[TableColumn], known: set[str]
) -> Iterator[str]:
    """Yield lines, as comments, for the columns that may be what the map does not have yet."""
    guessed = [c for c in rest if c.header.quantity not in known | {TIME, ""}]
    for column in guessed:
        line = _propose(table, column, is_first=True)
        yield line if line.startswith("#") else f"# {line}  # if it is {column.header.quantity}"
    others = [column for column in rest if column not in guessed]
    able = [column for column in others if _may_be_measured(column)]
    if others:
        open_ones = _EXAMPLES.keys() - known - {column.header.quantity for column in guessed}
        lines = []
        for quantity, example in _EXAMPLES.items():
            # What states a unit of its own is of that quantity, if of any.
            free = [c for c in able if c.header.measures in ("", quantity)]
            fits = [c for c in free if c.header.measures or not c.header.said_unit]
            # A gain may turn a motor's current into a force, but no oven into a rig.
            fits = fits or (free if "gain" in example and known - {TIME} else [])
            if quantity in open_ones and fits:
                unit = fits[0].header.unit if fits[0].header.measures else example["unit"]
                keys = {"column": table.name_of(fits[0]), **example, "unit": unit}
                lines.append(f"# {write_key(KEYS[quantity], keys)}")
        listed = ", ".join(quote(column.name) for column in others[:20])
        yield f"# other columns: {listed}" + ("; such as" if lines else "")
        yield from lines


def _may_be_measured(column: TableColumn) -> bool:
    """Tell whether a column may be a sensor's or a command: no constant, no status, no time."""
    is_named = column.header.others and not column.header.measures
    is_time = NAMES[TIME] & split_words(column.name)
    return not (is_named or is_time) and bool((np.diff(column.values) != 0.0).any())


def show_map(doubt: str, lines: Sequence[str]) -> str:
    """Return a refusal with the lines of a map below it."""
    return "\n".join([doubt, *(f"  {line}" for line in lines)])


def _propose(table: MeasuredTable, column: TableColumn, *, is_first: bool) -> str:
    """Return a line for a column in doubt; a comment where the user must fill something in."""
    header = column.header
    unit = header.unit or next(iter(UNITS[header.quantity]))
    keys: dict[str, Any] = {"column": table.name_of(column), "unit": unit}
    remark = ""
    if header.quantity == "pressure_pa":
        keys["gauge"] = bool(header.is_gauge)
        if header.is_gauge is None and header.unit:
            keys["gauge"] = find_lowest_pa(column) < NEVER_ABSOLUTE_PA
            remark = f"or gauge: {str(not keys['gauge']).lower()}; the file does not say"
    line = _write_in_range(column, keys, remark)
    if (angle := explain_angle(header.said_unit)) and header.quantity == "position_m":
        return f"# {line}  # {angle}"
    if scale := _propose_scale(column):
        remark = f"if it spans -5 to 5 V, and more {header.said_unit} fill"
        return f"# {write_key(KEYS[header.quantity], keys | scale, remark)}"
    if header.said_unit.lower() in CURRENTS and header.quantity == "force_n":
        return f"# {line}  # a motor's current: add gain, its force in N per A"
    if not header.unit:
        per = f" per {header.said_unit}" if header.said_unit else ""
        return f"# {line}  # its unit is not known: write unit, or gain ({unit}{per}) and offset"
    return line if is_first else f"# {line}  # or this one"


def _write_in_range(column: TableColumn, keys: Mapping[str, Any], remark: str = "") -> str:
    """Return a column's line; volts of a driver get what makes the command of them, and why."""
    quantity = column.header.quantity
    if quantity == "valve_v" and column.header.unit:
        part = ValveMap.model_validate(keys)
        values = UNITS[quantity][part.unit] * column.values
        for doubt, _, change in doubt_command(part, values[np.isfinite(values)]):
            keys, remark = describe_part(part.model_copy(update=change)), doubt
    return write_key(KEYS[quantity], keys, remark)


_SPANS_OF_A_COMMAND = {"ma": ((4.0, 20.0), (0.0, 20.0)), "%": ((0.0, 100.0), (-100.0, 100.0))}
"""By a unit in lower case, the likeliest first."""


def _propose_scale(column: TableColumn) -> dict[str, float] | None:
    """Return what turns the span of a command in mA or % into -5 to 5 V; None if nothing does."""
    header, values = column.header, column.values[np.isfinite(column.values)]
    if header.quantity != "valve_v" or not len(values):
        return None
    for low, high in _SPANS_OF_A_COMMAND.get(header.said_unit.lower(), ()):
        slack = 0.02 * (high - low)
        if low - slack <= values.min() and values.max() <= high + slack:
            gain = 10.0 / (high - low)
            return {"gain": gain, "offset": -5.0 - gain * low}
    return None


def _propose_time(table: MeasuredTable, columns: Sequence[TableColumn]) -> str:
    """Return the line for the first column that always rises, else for a rate."""
    for column in columns:
        if period := find_period(column):
            unit = "s" if period < 0.5 else "ms" if period < 1e3 else "us" if period < 1e6 else "ns"
            keys = {"column": table.name_of(column), "unit": column.unit or unit}
            remark = "" if column.unit else f"a row every {period:g}: is it in {unit}?"
            return write_key("time", keys, remark)
    return "time: {rate_hz: 1000}  # no column always rises: write the rows per second"


def find_period(column: TableColumn) -> float:
    """Return the usual step of a column that always rises; 0 of another."""
    step = np.diff(column.values)
    return float(np.median(step)) if len(step) and bool((step > 0.0).all()) else 0.0


def find_lowest_pa(column: TableColumn, share: float = 0.001) -> float:
    """Return what all but this share of the values are above."""
    values = column.values[np.isfinite(column.values)]
    lowest = float(np.quantile(values, share)) if len(values) else np.nan
    return lowest * UNITS["pressure_pa"][column.header.unit]
