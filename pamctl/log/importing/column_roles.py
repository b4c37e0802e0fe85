"""Which column of a table is which quantity: by its header, or by asking.

A doubt is a question: the refusal holds a map that can be used as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.log.importing.column_map import (
    KEYS,
    ImportMap,
    quote,
)
from pamctl.log.importing.headers import (
    NAMES,
    OF_A_COMMAND,
    OTHER,
    TIME,
    UNITS,
    Certainty,
    explain_angle,
    parse_column_name,
    split_words,
)
from pamctl.log.importing.measured_table import (
    Floats,
    ImportRefused,
    MeasuredTable,
    TableColumn,
)
from pamctl.log.importing.shown_map import NEVER_ABSOLUTE_PA, find_lowest_pa, find_period, refuse

OF_THE_AIR_PA = (95e3, 106e3)
"""A vented muscle's absolute pressure, at any height and weather of a laboratory."""


class ChosenColumns(NamedTuple):
    """What is read from which column, and why the others are left out."""

    map: ImportMap
    columns: Mapping[str, TableColumn]
    """The column of each quantity."""
    left_out: Mapping[int, str]
    """Why, by a column's number."""
    warnings: Sequence[tuple[str, str]] = ()
    """Kind and text."""


def choose_by_map(table: MeasuredTable, import_map: ImportMap) -> ChosenColumns:
    """Return the columns that a map names; raise ImportRefused where there is no such column."""
    columns = {q: table.find(part.column or "") for q, part in import_map.parts().items()}
    for column in columns.values():
        if column.is_text:
            raise ImportRefused(f"{column.name} holds {column.says or 'words'}, no numbers")
    rest = [n for n, c in enumerate(table.columns, 1) if c not in columns.values()]
    left_out = dict.fromkeys(rest, "the map does not name it")
    warnings = [*_find_contradictions(import_map, columns), *_find_unused_parts(table, columns)]
    return ChosenColumns(import_map, columns, left_out, warnings)


def _find_contradictions(
    import_map: ImportMap, columns: Mapping[str, TableColumn]
) -> Iterator[tuple[str, str]]:
    """Yield where a header says another unit, or another sense of a pressure, than the map."""
    senses = {True: "gauge", False: "absolute", None: ""}
    for quantity, part in import_map.parts().items():
        header = columns[quantity].header
        if header.measures not in (quantity, "valve_v") or abs(getattr(part, "gain", 1.0)) != 1.0:
            continue
        unit = header.unit or header.said_unit  # volts may be those of any sensor
        mapped_sense = senses[getattr(part, "gauge", None)]
        for said, mapped in ((unit, part.unit), (senses[header.is_gauge], mapped_sense)):
            if said and said != mapped:
                name = quote(columns[quantity].name)
                yield "map", f"{name} says {said}, and the map {mapped}: the map is followed"


def names_quantity(column: TableColumn, quantity: str) -> bool:
    """Tell whether a column's header names a quantity, and no guess is needed."""
    return column.header.quantity == quantity and column.header.certainty >= Certainty.DOUBT


def _find_unused_parts(
    table: MeasuredTable, columns: Mapping[str, TableColumn]
) -> Iterator[tuple[str, str]]:
    """Yield which columns are left out that show another valve, chamber or joint."""
    for column in table.columns:
        quantity = column.header.quantity
        used = columns.get(quantity)
        if used is None or quantity not in _SEVERAL or column in columns.values():
            continue
        if _are_of_two_parts(used, column):
            yield (
                "columns",
                f"{quote(column.name)} is not used, and moves apart from {quote(used.name)}: are "
                f"they {_SEVERAL[quantity]}? pamctl describes one valve, one chamber and "
                "one joint, and takes what another one does for a fault of this one",
            )


def choose_by_header(table: MeasuredTable) -> ChosenColumns:
    """Return the columns that their headers name, each with its unit.

    Raise ImportRefused, with a map to fill in, where several columns may be one quantity, a
    pressure may be gauge or absolute, a quantity is named without a unit that it has, or there is
    no time. A column in doubt is taken where no other one may be that quantity. A table of two
    valves, chambers or joints is refused without a map.
    """
    found = {q: [c for c in table.columns if names_quantity(c, q)] for q in UNITS}
    _require_one_of_each(found)
    _ask_for_units(table, found)
    left_out = {
        number: _say_why_unread(column)
        for number, column in enumerate(table.columns, 1)
        if column.header.certainty < Certainty.DOUBT
    }
    keys: dict[str, dict[str, Any]] = {}
    columns: dict[str, TableColumn] = {}
    doubts: list[str] = []
    warnings: list[tuple[str, str]] = []
    for quantity, named in found.items():
        surest = max((c.header.certainty for c in named if _is_clear(c)), default=Certainty.SURE)
        clear = [c for c in named if _is_clear(c) and c.header.certainty == surest]
        if not clear and named and (unit := _find_only_unit(table, named)):
            clear = named
            told = f"{quote(named[0].name)} is taken as {quantity} in {unit}, as no other column "
            warnings.append(("map", f"{told}may be it; if that is wrong, use --map"))
        if not clear:
            doubts += map(_ask, named)
            continue
        first = clear[0]
        for column in named:
            if column not in clear:
                left_out[table.number_of(column)] = f"{quantity} is in {first.name!r}"
            elif column is not first and quantity == TIME and _is_same_time(first, column):
                same = f"the same time as in column {table.number_of(first)}"
                left_out[table.number_of(column)] = same
                clear.remove(column)
        if len(clear) > 1:
            names = " and ".join(quote(column.name) for column in clear)
            doubts.append(f"{names} may each be {quantity}")
        else:
            columns[quantity] = first
            keys[KEYS[quantity]] = _read_as(table, first, doubts, warnings)
    if not doubts and TIME in columns and not columns.keys() & {"pressure_pa", "position_m"}:
        doubts += _explain_nothing([c for c in table.columns if c is not columns[TIME]])
    if doubts or TIME not in columns:
        settled = {q: key for q in columns if (key := keys[KEYS[q]]).get("gauge", 0) is not None}
        raise refuse(table, doubts, settled, found)
    asked = {q: column for q, column in columns.items() if not parse_column_name(column.name)}
    warnings += _find_unused_parts(table, asked)
    return ChosenColumns(ImportMap.model_validate(keys), columns, left_out, warnings)


def _explain_nothing(rest: Sequence[TableColumn]) -> Iterator[str]:
    """Yield why none of these columns is a pressure or a position."""
    yield "no column is a pressure or a position by its name"
    for column in rest:
        if column.header.others and column.header.measures in ("pressure_pa", "position_m"):
            word = quote(min(column.header.others))
            yield f"{quote(column.name)} is left out for the word {word} in it"
    if rest and all(c.header.said_unit and not (c.header.unit or c.header.quantity) for c in rest):
        units = ", ".join(dict.fromkeys(column.header.said_unit for column in rest))
        yield f"pamctl describes air and what it moves, and {units} measure neither"


def _ask_for_units(table: MeasuredTable, found: dict[str, list[TableColumn]]) -> None:
    """Put columns into doubt whose unit alone is that of a pressure or position that is missing."""
    if not (found["position_m"] and found["force_n"]):
        for quantity in ("pressure_pa", "position_m"):
            found[quantity] = found[quantity] or [
                c for c in table.columns if c.header.quantity == c.header.measures == quantity
            ]


def _is_clear(column: TableColumn) -> bool:
    header = column.header
    return header.certainty >= Certainty.SURE and bool(header.unit) and not column.is_text


MOST_PERIOD_S = 0.025
"""Times that rise by no more are seconds: as milliseconds they would be of 40 kHz or more."""


def _find_only_unit(table: MeasuredTable, named: Sequence[TableColumn]) -> str:
    """Return the unit of a column in doubt that alone may be its quantity; empty for another."""
    header, words = named[0].header, split_words(named[0].called or named[0].name)
    if len(named) > 1 or named[0].is_text or header.certainty < Certainty.DOUBT:
        return ""
    if header.quantity == TIME and not header.said_unit:
        return "s" if 0.0 < find_period(named[0]) <= MOST_PERIOD_S else ""
    is_other = any(q != header.quantity and its & words for q, its in NAMES.items())
    rest = (c.header for c in table.columns if c is not named[0] and not c.header.others)
    is_one = not is_other and not any(h.unit in UNITS[header.quantity] for h in rest)
    return header.unit if is_one else ""


def _say_why_unread(column: TableColumn) -> str:
    if column.is_text:
        return column.says or "words, no numbers"
    if others := column.header.others:
        return f"{min(others)!r} in its name is not what a sensor of the rig measures"
    unread = "its name says no quantity with its unit that pamctl reads"
    return explain_angle(column.header.said_unit) or unread


_INDEX = re.compile(r"\d+|(?<![^\W_])[a-d](?![^\W_])", re.I)
"""What tells `u1` from `u2`, and `Chamber A pressure` from `Chamber B pressure`."""
_MOVES = 0.1
"""A column whose span is a smaller share of its largest value is no part of what moves."""
_TOGETHER = 0.99
"""Columns of a higher correlation are two sensors of one part."""
_ALIKE = 0.1
"""By a larger share the spans of two sensors of one pressure do not differ. The pressures of a
cylinder's two sides rise together, and stand in the ratio of its areas."""
_SEVERAL = {
    "valve_v": "the commands of several valves",
    "pressure_pa": "the pressures of several chambers",
    "position_m": "the positions of several joints",
    "force_n": "the forces of several actuators",
}


def _require_one_of_each(found: Mapping[str, Sequence[TableColumn]]) -> None:
    """Raise ImportRefused where columns of one quantity are of several parts.

    They differ by a number or a letter, or their names say as much of the quantity.
    """
    for quantity, what in _SEVERAL.items():
        named = found[quantity]
        alike: dict[str, list[TableColumn]] = {}
        for column in named:
            if _INDEX.search(column.name):
                alike.setdefault(_INDEX.sub("#", column.name).lower(), []).append(column)
        for columns in (*alike.values(), [c for c in named if _is_clear(c)] or named):
            if any(parse_column_name(column.name) for column in columns):
                continue
            if any(_are_of_two_parts(a, b) for a, b in combinations(columns, 2)):
                listed = " and ".join(quote(column.name) for column in columns)
                raise ImportRefused(
                    f"{listed} look like {what}, and pamctl describes one valve, one chamber and "
                    "one joint: record one of them at a time with the others vented, or give a "
                    "cylinder's force (A1 p1 - A2 p2) as a column force_n with `plant new "
                    "--actuator direct`, or name the one that counts in a map"
                )


_OF_ONE_PART = frozenset({
    "raw", "filtered", "filt", "filter", "smooth", "smoothed", "lowpass", "avg", "average", "roh",
    "gefiltert",
})  # fmt: skip
"""Words by which the names of two signals of one part differ."""


def _are_of_two_parts(one: TableColumn, other: TableColumn) -> bool:
    """Tell whether columns of one quantity are of two valves, chambers or joints: they move apart.

    A raw and a filtered one, a set point, two sensors of one part, and a supply that rests are
    another question.
    """
    if one.is_text or other.is_text or not (_does_move(one.values) and _does_move(other.values)):
        return False
    apart = split_words(one.called or one.name) ^ split_words(other.called or other.name)
    if apart & (_OF_ONE_PART | OTHER | OF_A_COMMAND) or len(one.values) != len(other.values):
        return False
    both = np.isfinite(one.values) & np.isfinite(other.values)
    if both.sum() < 2:
        return False
    together = np.corrcoef(one.values[both], other.values[both])[0, 1]
    return bool(together < _TOGETHER) or _differ_in_span(one, other, both)


def _differ_in_span(one: TableColumn, other: TableColumn, both: NDArray[np.bool_]) -> bool:
    """Tell whether two pressures of stated units move by different amounts over the same rows."""
    of_pa, headers = UNITS["pressure_pa"], (one.header, other.header)
    if any(header.measures != "pressure_pa" for header in headers):
        return False
    spans = [of_pa[c.header.unit] * np.std(c.values[both]) for c in (one, other)]
    return bool(min(spans) < (1.0 - _ALIKE) * max(spans))


def _does_move(values: Floats) -> bool:
    good = values[np.isfinite(values)]
    return bool(len(good) and np.ptp(good) > _MOVES * np.abs(good).max())


def _is_same_time(one: TableColumn, other: TableColumn) -> bool:
    first, second = (c.values * UNITS[TIME][c.header.unit] for c in (one, other))
    return np.array_equal(first, second, equal_nan=True)


def _read_as(
    table: MeasuredTable,
    column: TableColumn,
    doubts: list[str],
    warnings: list[tuple[str, str]],
) -> dict[str, Any]:
    """Return the keys of a column; `gauge` is None, with a doubt, where the file does not tell."""
    header = column.header
    keys: dict[str, Any] = {"column": table.name_of(column), "unit": header.unit or "s"}
    if header.quantity != "pressure_pa":
        return keys
    keys["gauge"] = header.is_gauge
    if header.is_gauge is None:
        lowest_pa = find_lowest_pa(column)
        if lowest_pa < NEVER_ABSOLUTE_PA:
            keys["gauge"] = True
            least_pa = find_lowest_pa(column, share=0.0)
            sense = f"gauge, as an absolute one does not fall to {least_pa:.5g} Pa"
        elif OF_THE_AIR_PA[0] <= lowest_pa <= OF_THE_AIR_PA[1]:
            keys["gauge"] = False
            sense = f"absolute, as it falls to {lowest_pa:.4g} Pa, the atmosphere's"
        else:
            doubts.append(f"{quote(column.name)} may be gauge or absolute")
            return keys
        taken = f"{column.name} is taken as {sense}; if that is wrong, use --map"
        warnings.append(("gauge", taken))
    return keys


def _ask(column: TableColumn) -> str:
    name, quantity, said = quote(column.name), column.header.quantity, column.header.said_unit
    if column.is_text:
        return f"{name} may be {quantity}, but holds {column.says or 'words'}"
    if column.header.unit:
        return f"{name} may be {quantity}, or something else"
    if not said:
        return f"{name} states no unit for {quantity}"
    if quantity == "position_m" and (angle := explain_angle(said)):
        return f"{name} is {angle}"
    units = ", ".join(UNITS[quantity])
    return (
        f"{name} is in {said!r}, which is no unit of {quantity} ({units}): `gain` and `offset` in "
        "the map turn it into one of them"
    )
