"""Which column of a table is which quantity: by its header, or by asking.

A doubt is a question: the refusal holds a map that can be used as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from pamctl.log.importing.column_map import (
    KEYS,
    RADIANS,
    TIME,
    UNITS,
    ColumnMap,
    ImportMap,
    PressureMap,
    describe_part,
    parse_column_name,
    quote,
    write_key,
)
from pamctl.log.importing.headers import (
    NAMES,
    OF_A_COMMAND,
    OTHER,
    HeaderMeaning,
    names_another,
    say_why_unread,
    split_unit,
    split_words,
    tell_gauge,
    understand_column,
)
from pamctl.log.importing.measured_table import (
    Floats,
    ImportRefused,
    MapWanted,
    MeasuredTable,
    TableColumn,
)

NEVER_ABSOLUTE_PA = 80e3
"""An absolute pressure in a muscle does not fall so low."""
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


class _Candidate(NamedTuple):
    number: int
    column: TableColumn
    meaning: HeaderMeaning

    @property
    def is_clear(self) -> bool:
        return self.meaning.is_sure and bool(self.meaning.unit) and not self.column.is_text


def choose_by_map(table: MeasuredTable, import_map: ImportMap) -> ChosenColumns:
    """Return the columns that a map names; raise ImportRefused where there is no such column."""
    columns = {q: table.find(part.column or "") for q, part in import_map.parts().items()}
    for column in columns.values():
        if column.is_text:
            raise ImportRefused(f"{column.name} holds {column.says or 'words'}, no numbers")
    used = [id(column) for column in columns.values()]
    left_out = {
        number: "the map does not name it"
        for number, column in enumerate(table.columns, 1)
        if id(column) not in used
    }
    warnings = [*_find_contradictions(import_map, columns), *_find_unused_parts(table, columns)]
    return ChosenColumns(import_map, columns, left_out, warnings)


def _find_contradictions(
    import_map: ImportMap, columns: Mapping[str, TableColumn]
) -> Iterator[tuple[str, str]]:
    """Yield where a header says another unit, or another sense of a pressure, than the map."""
    senses = {True: "gauge", False: "absolute", None: ""}
    for quantity, part in import_map.parts().items():
        meaning = understand_column(columns[quantity])
        if meaning is None or meaning.quantity != quantity or getattr(part, "gain", 1.0) != 1.0:
            continue
        gauge = getattr(part, "gauge", None)
        for said, mapped in (
            (meaning.unit, part.unit),
            (senses[meaning.is_gauge], senses[gauge]),
        ):
            if said and said != mapped:
                name = quote(columns[quantity].name)
                yield "map", f"{name} says {said}, and the map {mapped}: the map is followed"


def list_stated_units(chosen: ChosenColumns) -> dict[str, str]:
    """Return the units that the names of the columns state, by quantity."""
    found = {q: understand_column(column) for q, column in chosen.columns.items()}
    return {q: m.unit for q, m in found.items() if m and m.quantity == q and m.unit}


def _find_unused_parts(
    table: MeasuredTable, columns: Mapping[str, TableColumn]
) -> Iterator[tuple[str, str]]:
    """Yield which columns are left out that show another valve, chamber or joint."""
    used = {id(column) for column in columns.values()}
    for column in table.columns:
        meaning = None if id(column) in used else understand_column(column) or _guess(column)
        of_rig = columns.get(meaning.quantity) if meaning is not None else None
        if meaning is None or of_rig is None or meaning.quantity not in _SEVERAL:
            continue
        if _are_of_two_parts(of_rig, column):
            yield (
                "columns",
                f"{quote(column.name)} is not used, and moves apart from {quote(of_rig.name)}: are "
                f"they {_SEVERAL[meaning.quantity]}? pamctl describes one valve, one chamber and "
                "one joint, and takes what another one does for a fault of this one",
            )


def choose_by_header(table: MeasuredTable) -> ChosenColumns:
    """Return the columns that their headers name, each with its unit.

    Raise ImportRefused, with a map to fill in, where two columns may be one quantity, a word leaves
    a doubt, a pressure may be gauge or absolute, a quantity is named without a unit that it has, or
    there is no time. A table of two valves, chambers or joints is refused without a map.
    """
    candidates: dict[str, list[_Candidate]] = {quantity: [] for quantity in UNITS}
    left_out: dict[int, str] = {}
    for number, column in enumerate(table.columns, 1):
        meaning = understand_column(column)
        if meaning is not None:
            candidates[meaning.quantity].append(_Candidate(number, column, meaning))
        elif column.is_text:
            left_out[number] = column.says or "words, no numbers"
        else:
            left_out[number] = say_why_unread(column)
    _require_one_of_each(candidates)
    keys: dict[str, dict[str, Any]] = {}
    columns: dict[str, TableColumn] = {}
    doubts: list[str] = []
    warnings: list[tuple[str, str]] = []
    for quantity, found in candidates.items():
        clear = [one for one in found if one.is_clear]
        clear = [one for one in clear if one.meaning.is_plain] or clear
        doubts += [] if clear else [_ask(one) for one in found]
        rivals: list[_Candidate] = []
        for one in clear:
            if rivals and quantity == TIME and _is_same_time(rivals[0], one):
                left_out[one.number] = f"the same time as in column {rivals[0].number}"
            else:
                rivals.append(one)
        for one in found if clear else ():
            if one not in clear:
                left_out[one.number] = f"{quantity} is in {clear[0].column.name!r}"
        if len(rivals) > 1:
            names = " and ".join(quote(one.column.name) for one in rivals)
            doubts.append(f"{names} may each be {quantity}")
        elif rivals:
            columns[quantity] = rivals[0].column
            keys[KEYS[quantity]] = _read_as(table, rivals[0], doubts, warnings)
    if not doubts and TIME in columns and not columns.keys() & {"pressure_pa", "position_m"}:
        doubts.append("no column is a pressure or a position by its name")
    if doubts or TIME not in columns:
        settled = {q: key for q in columns if (key := keys[KEYS[q]]).get("gauge", 0) is not None}
        raise MapWanted(_refuse(table, doubts, settled, candidates))
    asked = {q: column for q, column in columns.items() if not parse_column_name(column.name)}
    warnings += _find_unused_parts(table, asked)
    return ChosenColumns(ImportMap.model_validate(keys), columns, left_out, warnings)


_INDEX = re.compile(r"\d+|(?<![^\W_])[a-d](?![^\W_])", re.I)
"""What tells `u1` from `u2`, and `Chamber A pressure` from `Chamber B pressure`."""
_MOVES = 0.1
"""A column whose span is a smaller share of its largest value is no part of what moves."""
_TOGETHER = 0.99
"""Columns of a higher correlation are two sensors of one part."""
_SEVERAL = {
    "valve_v": "the commands of several valves",
    "pressure_pa": "the pressures of several chambers",
    "position_m": "the positions of several joints",
    "force_n": "the forces of several actuators",
}


def _require_one_of_each(candidates: Mapping[str, Sequence[_Candidate]]) -> None:
    """Raise ImportRefused where columns of one quantity are of several parts.

    They differ by a number or a letter, or their names say as much of the quantity.
    """
    for quantity, what in _SEVERAL.items():
        alike: dict[str, list[TableColumn]] = {}
        for one in candidates[quantity]:
            if _INDEX.search(one.column.name):
                kind = _INDEX.sub("#", one.column.name).lower()
                alike.setdefault(kind, []).append(one.column)
        clear = [one.column for one in candidates[quantity] if one.is_clear]
        for columns in (*alike.values(), clear or [one.column for one in candidates[quantity]]):
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
    of_one = _OF_ONE_PART | OTHER | OF_A_COMMAND
    return not apart & of_one and _move_apart(one.values, other.values)


def _does_move(values: Floats) -> bool:
    good = values[np.isfinite(values)]
    return bool(len(good) and np.ptp(good) > _MOVES * np.abs(good).max())


def _move_apart(one: Floats, other: Floats) -> bool:
    if len(one) != len(other):
        return False
    both = np.isfinite(one) & np.isfinite(other)
    return bool(both.sum() > 1 and np.corrcoef(one[both], other[both])[0, 1] < _TOGETHER)


def _is_same_time(one: _Candidate, other: _Candidate) -> bool:
    first, second = (c.column.values * UNITS[TIME][c.meaning.unit] for c in (one, other))
    return np.array_equal(first, second, equal_nan=True)


def _read_as(
    table: MeasuredTable,
    one: _Candidate,
    doubts: list[str],
    warnings: list[tuple[str, str]],
) -> dict[str, Any]:
    """Return the keys of a column; `gauge` is None, with a doubt, where the file does not tell."""
    column, meaning = one.column, one.meaning
    keys: dict[str, Any] = {"column": table.name_of(column), "unit": meaning.unit}
    if meaning.quantity == "pressure_pa":
        keys["gauge"] = meaning.is_gauge
        if meaning.is_gauge is None:
            lowest_pa = _find_lowest_pa(one)
            sense = ""
            if lowest_pa < NEVER_ABSOLUTE_PA:
                sense = f"gauge, as an absolute one does not fall to {lowest_pa:.4g} Pa"
            elif OF_THE_AIR_PA[0] <= lowest_pa <= OF_THE_AIR_PA[1]:
                sense = f"absolute, as it falls to {lowest_pa:.4g} Pa, the atmosphere's"
            if sense:
                keys["gauge"] = sense.startswith("gauge")
                warnings.append(
                    ("gauge", f"{column.name} is taken as {sense}; if that is wrong, use --map")
                )
            else:
                doubts.append(f"{quote(column.name)} may be gauge or absolute")
    return keys


def _find_lowest_pa(one: _Candidate) -> float:
    values = one.column.values[np.isfinite(one.column.values)]
    lowest = float(np.quantile(values, 0.001)) if len(values) else np.nan
    return lowest * UNITS["pressure_pa"][one.meaning.unit]


def _ask(one: _Candidate) -> str:
    name, quantity, said = quote(one.column.name), one.meaning.quantity, one.meaning.said_unit
    if one.column.is_text:
        return f"{name} may be {quantity}, but holds {one.column.says or 'words'}"
    if one.meaning.unit:
        return f"{name} may be {quantity}, or something else"
    if not said:
        return f"{name} states no unit for {quantity}"
    if quantity == "position_m" and (radians := RADIANS.get(said.lower())):
        return (
            f"{name} is an angle: as a position it counts along the arc on which the muscle or rod "
            f"pulls, so the map's gain is the radius of the pulley or lever in m times {radians:g}"
        )
    units = ", ".join(UNITS[quantity])
    return (
        f"{name} is in {said!r}, which is no unit of {quantity} ({units}): `gain` and `offset` in "
        "the map turn it into one of them"
    )


# The map that a refusal shows.

_EXAMPLES: Mapping[str, Mapping[str, Any]] = {
    "valve_v": {"unit": "V", "gain": 1.0, "offset": 0.0},
    "pressure_pa": {"unit": "kPa", "gauge": True},
    "position_m": {"unit": "mm"},
    "force_n": {"unit": "N", "gain": 1.0},
}


def _guess(column: TableColumn) -> HeaderMeaning | None:
    """Return what a column may be whose name leaves it open: by its unit, or by one of its words.

    None where neither tells, or where a word says that it is another thing.
    """
    label, said, found = split_unit(column.called or column.name, column.unit)
    words = split_words(label)
    named = [quantity for quantity, its in NAMES.items() if its & words]
    if column.is_text or words & OTHER or len(named) > 1:
        return None
    if found is not None and found.quantity == (named or [found.quantity])[0]:
        gauge = tell_gauge(found, words)
        return HeaderMeaning(found.quantity, found.unit, gauge, is_sure=False, said_unit=said)
    return HeaderMeaning(named[0], "", None, is_sure=False, said_unit=said) if named else None


def _refuse(
    table: MeasuredTable,
    doubts: Sequence[str],
    settled: Mapping[str, Mapping[str, Any]],
    candidates: Mapping[str, Sequence[_Candidate]],
) -> str:
    doubts = list(doubts)
    if TIME not in settled and not candidates[TIME]:
        names = ", ".join(dict.fromkeys(column.name for column in table.columns[:20]))
        if all(column.name.isdecimal() for column in table.columns):
            doubts.append(
                f"there is no line of names above the numbers: the columns are called {names}"
            )
        else:
            doubts.append(
                "no column is called t_s, time_s, time_ms, `Time [s]` or the like, with the unit "
                f"in its name; there are {names}"
            )
    lines = []
    for quantity, found in candidates.items():
        usable = [one for one in found if not one.column.is_text]
        if quantity in settled:
            lines.append(write_key(KEYS[quantity], settled[quantity]))
        elif quantity == TIME and not any(one.meaning.unit for one in usable):
            rising = [one.column for one in usable] or table.columns
            lines.append(_propose_time(table, rising))
        else:
            lines += [_propose(table, one, is_first=one is usable[0]) for one in usable]
    doubts += table.notes
    known = [id(one.column) for found in candidates.values() for one in found]
    rest = [c for c in table.columns if id(c) not in known and not c.is_text]
    rest = [c for c in rest if not lines[0].startswith(f"time: {{column: {quote(c.name)},")]
    lines += _propose_others(table, rest, {q for q, found in candidates.items() if found})
    lines += [write_key(key, value) for key, value in table.mend.items()]
    return show_map("; ".join(doubts) + "; say which with --map FILE, such as:", lines)


def propose_missing(table: MeasuredTable, chosen: ChosenColumns) -> list[str]:
    """Return lines of a map, as comments, for columns that may be what is not read yet."""
    used = {id(column) for column in chosen.columns.values()}
    rest = [
        column
        for column in table.columns
        if id(column) not in used and not column.is_text and not names_another(column)
    ]
    return [*_propose_others(table, rest, {*chosen.columns})]


def _propose_others(
    table: MeasuredTable, rest: Sequence[TableColumn], known: set[str]
) -> Iterator[str]:
    """Yield lines, as comments, for the columns that may be what the map does not have yet."""
    guessed: set[str] = set()
    others = []
    for number, column in enumerate(rest):
        meaning = _guess(column)
        if meaning is None or meaning.quantity in known | {TIME}:
            others.append(column)
            continue
        line = _propose(table, _Candidate(number, column, meaning), is_first=True)
        quantity = meaning.quantity
        yield line if line.startswith("#") else f"# {line}  # if it is {quantity}"
        guessed.add(quantity)
    if others:
        open_ones = [quantity for quantity in _EXAMPLES if quantity not in known | guessed]
        listed = ", ".join(quote(column.name) for column in others[:20])
        yield f"# other columns: {listed}" + ("; such as" if open_ones else "")
        for quantity in open_ones:
            keys = {"column": table.name_of(others[0]), **_EXAMPLES[quantity]}
            yield f"# {write_key(KEYS[quantity], keys)}"


def show_map(doubt: str, lines: Sequence[str]) -> str:
    """Return a refusal with the lines of a map below it."""
    return "\n".join([doubt, *(f"  {line}" for line in lines)])


def _propose(table: MeasuredTable, one: _Candidate, *, is_first: bool) -> str:
    """Return a line for a column in doubt; a comment where the user must fill something in."""
    meaning = one.meaning
    quantity = meaning.quantity
    unit = meaning.unit or next(iter(UNITS[quantity]))
    keys: dict[str, Any] = {"column": table.name_of(one.column), "unit": unit}
    remark = ""
    if quantity == "pressure_pa":
        keys["gauge"] = bool(meaning.is_gauge)
        if meaning.is_gauge is None and meaning.unit:
            keys["gauge"] = _find_lowest_pa(one) < NEVER_ABSOLUTE_PA
            remark = f"or gauge: {str(not keys['gauge']).lower()}; the file does not say"
    if not meaning.unit:
        per = f" per {meaning.said_unit}" if meaning.said_unit else ""
        line = write_key(KEYS[quantity], keys)
        return f"# {line}  # its unit is not known: write unit, or gain ({unit}{per}) and offset"
    line = write_key(KEYS[quantity], keys, remark)
    return line if is_first else f"# {line}  # or this one"


def _propose_time(table: MeasuredTable, columns: Sequence[TableColumn]) -> str:
    """Return the line for the first column that always rises, else for a rate."""
    for column in columns:
        step = np.diff(column.values)
        if len(step) and bool((step > 0.0).all()):
            period = float(np.median(step))
            unit = "s" if period < 0.5 else "ms" if period < 1e3 else "us" if period < 1e6 else "ns"
            keys = {"column": table.name_of(column), "unit": column.unit or unit}
            remark = "" if column.unit else f"a row every {period:g}: is it in {unit}?"
            return write_key("time", keys, remark)
    return "time: {rate_hz: 1000}  # no column always rises: write the rows per second"


def describe_reading(part: ColumnMap) -> str:
    """Return a quantity, the unit of its column, and what is done to it."""
    keys = describe_part(part)
    scaled = f" x {keys['gain']:g}" if "gain" in keys else ""
    moved = f" {keys['offset']:+g}" if "offset" in keys else ""
    shift = f", shifted {keys['shift_s']:+g} s" if "shift_s" in keys else ""
    gauge = ""
    if isinstance(part, PressureMap):
        gauge = " gauge" if part.gauge else " absolute"
    return f"{part.quantity}{scaled}{moved}, {part.unit}{gauge}{shift}"
