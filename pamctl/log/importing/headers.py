"""Choose the columns of a table by their headers; where a header leaves a doubt, ask for a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pamctl.log.check import LogFindings
from pamctl.log.importing.header_words import HeaderMeaning, understand_header
from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable
from pamctl.log.importing.quantities import (
    TIME,
    ColumnReading,
    parse_column_name,
)

NEVER_ABSOLUTE_PA = 80e3
"""An absolute pressure in a muscle does not fall so low."""
OF_THE_AIR_PA = (95e3, 106e3)
"""A vented muscle's absolute pressure, at any height and weather of a laboratory."""
_MAP_LINES = {
    TIME: "time: {{column: {column}, unit: {unit}}}",
    "valve_v": "valve: {{column: {column}, unit: {unit}}}",
    "pressure_pa": "pressure: {{column: {column}, unit: {unit}, gauge: {gauge}}}",
    "position_m": "position: {{column: {column}, unit: {unit}}}",
    "force_n": "force: {{column: {column}, unit: {unit}}}",
}


@dataclass
class _Choice:
    """What the headers say: the sure columns, and those that leave a doubt, by quantity."""

    sure: dict[str, list[tuple[str, HeaderMeaning]]] = field(default_factory=dict)
    doubtful: dict[str, list[tuple[str, HeaderMeaning]]] = field(default_factory=dict)
    ignored: list[str] = field(default_factory=list)


def match_headers(table: MeasuredTable, findings: LogFindings) -> list[ColumnReading]:
    """Return the columns whose headers state quantity and unit.

    Raise ImportRefused, with the map to write, where two columns may be meant, or a header is
    not understood as a whole.
    """
    found = _match_plain_names(table)
    choice = _read_headers(table, found)
    doubts = []
    for quantity, columns in choice.sure.items():
        if len(columns) > 1:
            doubts.append(f"{' and '.join(name for name, _ in columns)} may each be {quantity}")
        elif (reading := _settle_reading(table, *columns[0], findings)) is not None:
            found[quantity] = reading
        else:
            doubts.append(f"{columns[0][0]} may be gauge or absolute")
    for quantity, columns in choice.doubtful.items():
        if quantity in choice.sure:
            choice.ignored += [name for name, _ in columns]
        else:
            listed = " and ".join(name for name, _ in columns)
            doubts.append(f"{listed} may be {quantity}, or something else")
    if doubts:
        raise ImportRefused(_ask_for_map("; ".join(doubts), table, found, choice))
    if TIME not in found:
        raise ImportRefused(_explain_no_time(table, found, choice))
    if choice.ignored:
        findings.note(
            "ignored",
            f"left out, no known quantity and unit in the name: {', '.join(choice.ignored[:20])}",
        )
    return list(found.values())


def _match_plain_names(table: MeasuredTable) -> dict[str, ColumnReading]:
    """Return the columns whose names are of the form `position_mm`."""
    found: dict[str, ColumnReading] = {}
    for column in table.columns:
        reading = _read_plain_name(table, column)
        if reading is None:
            continue
        if reading.quantity not in found:
            found[reading.quantity] = reading
        elif reading.quantity != TIME or not _is_same_time(table, found[TIME], reading):
            both = f"{found[reading.quantity].column} and {column}"
            raise ImportRefused(f"both {both} give {reading.quantity}; choose one with --map")
    return found


def _read_plain_name(table: MeasuredTable, column: str) -> ColumnReading | None:
    return parse_column_name(column) or parse_column_name(column, table.called.get(column, ""))


def _is_same_time(table: MeasuredTable, one: ColumnReading, other: ColumnReading) -> bool:
    first, second = table[one.column], table[other.column]
    return len(first) == len(second) and bool((one.to_si(first) == other.to_si(second)).all())


def _read_headers(table: MeasuredTable, found: Mapping[str, ColumnReading]) -> _Choice:
    choice = _Choice()
    for column in table.columns:
        if _read_plain_name(table, column) is not None:
            continue
        unit = table.units.get(column, "")
        meaning = understand_header(table.called.get(column) or column, unit)
        if meaning is None or meaning.quantity in found:
            choice.ignored.append(column)
        else:
            kind = choice.sure if meaning.is_sure else choice.doubtful
            kind.setdefault(meaning.quantity, []).append((column, meaning))
    return choice


def _settle_reading(
    table: MeasuredTable, column: str, meaning: HeaderMeaning, findings: LogFindings
) -> ColumnReading | None:
    """Return how to read a column; None for a pressure that may be gauge or absolute."""
    reading = ColumnReading(meaning.quantity, column, meaning.unit, gauge=bool(meaning.is_gauge))
    if meaning.quantity != "pressure_pa" or meaning.is_gauge is not None:
        return reading
    values_pa = reading.to_si(table[column])
    values_pa = values_pa[np.isfinite(values_pa)]
    lowest_pa = float(np.quantile(values_pa, 0.001)) if len(values_pa) else np.nan
    if lowest_pa < NEVER_ABSOLUTE_PA:
        sense = f"gauge, as an absolute one does not fall to {lowest_pa:.4g} Pa"
    elif OF_THE_AIR_PA[0] <= lowest_pa <= OF_THE_AIR_PA[1]:
        sense = f"absolute, as it falls to {lowest_pa:.4g} Pa, the atmosphere's"
    else:
        return None
    is_gauge = sense.startswith("gauge")
    findings.warning("gauge", f"{column} is taken as {sense}; if that is wrong, use --map")
    return ColumnReading("pressure_pa", column, meaning.unit, gauge=is_gauge)


def _ask_for_map(
    doubt: str, table: MeasuredTable, found: Mapping[str, ColumnReading], choice: _Choice
) -> str:
    """Return the refusal, with a map that holds every candidate."""
    readings = found.values()
    lines = [_write_map_line(r.quantity, r.column, r.unit, r.gauge) for r in readings]
    if not any(TIME in quantities for quantities in (found, choice.sure, choice.doubtful)):
        lines.insert(0, _write_map_line(TIME, _guess_time_column(table), "s or ms", None))
    for columns in (choice.sure, choice.doubtful):
        for quantity, candidates in columns.items():
            if not any(line.startswith(_MAP_LINES[quantity].split(":")[0]) for line in lines):
                lines += [
                    _write_map_line(quantity, name, meaning.unit, meaning.is_gauge)
                    for name, meaning in candidates
                ]
    known = ", ".join(line.partition(":")[0] for line in _MAP_LINES.values())
    head = f"{doubt}; say which with --map FILE, one line a quantity ({known}):"
    return "\n".join([head, *(f"  {line}" for line in lines)])


def _guess_time_column(table: MeasuredTable) -> str:
    """Return the first column that always rises; no map is taken before a person has read it."""
    rises = (name for name in table.columns if bool((np.diff(table[name]) > 0.0).all()))
    return next(rises, "NAME")


def _write_map_line(quantity: str, column: str, unit: str, is_gauge: bool | None) -> str:
    gauge = "true or false" if is_gauge is None else str(is_gauge).lower()
    quoted = "'" + column.replace("'", "''") + "'"
    return _MAP_LINES[quantity].format(column=quoted, unit=unit, gauge=gauge)


def _explain_no_time(
    table: MeasuredTable, found: Mapping[str, ColumnReading], choice: _Choice
) -> str:
    listed = ", ".join(list(table.columns)[:20])
    if all(name.isdigit() for name in table.columns):
        return (
            f"there is no line of names above the numbers: the columns are called {listed}; "
            "say what they hold with --map, such as `time: {column: 1, unit: ms}`"
        )
    doubt = (
        "no column is called t_s, time_s, time_ms, `Time [s]` or the like, with the unit in its "
        f"name; there are {listed}"
    )
    return _ask_for_map(doubt, table, found, choice)
