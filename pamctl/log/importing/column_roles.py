"""Which column of a table is which quantity, in which unit: by its header, or by asking.

`Pressure [bar]`, `Muscle pressure (kPa abs)`, `Weg/mm`, `position_mm`. The unit says which quantity
a column can hold; the words must agree. A word that is not known leaves a doubt, and a word for
something else (a set point, the supply) rules the column out. A doubt is a question: the refusal
holds a map that can be used as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable, TableColumn
from pamctl.log.importing.quantities import TIME, UNITS, ColumnReading, parse_column_name

NEVER_ABSOLUTE_PA = 80e3
"""An absolute pressure in a muscle does not fall so low."""
OF_THE_AIR_PA = (95e3, 106e3)
"""A vented muscle's absolute pressure, at any height and weather of a laboratory."""
_KEYS = {TIME: "time", "valve_v": "valve", "pressure_pa": "pressure", "position_m": "position",
         "force_n": "force"}  # fmt: skip


class HeaderMeaning(NamedTuple):
    """What a header says of its column."""

    quantity: str
    unit: str
    """Empty where it states none that this quantity has."""
    is_gauge: bool | None
    """Of a pressure; None if the header does not say it."""
    is_sure: bool
    """Whether every word is understood."""
    said_unit: str = ""
    """What stands in the place of the unit."""
    is_plain: bool = False
    """Whether it is pamctl's own name for the quantity and its unit, such as `valve_v`."""


class _Unit(NamedTuple):
    quantity: str
    unit: str
    is_gauge: bool | None


class ChosenColumns(NamedTuple):
    """What is read from which column, and why the others are left out."""

    readings: list[ColumnReading]
    columns: list[TableColumn]
    """The column of each reading."""
    left_out: dict[int, str]
    """Why, by a column's number."""
    warnings: list[str]


_NAMES: Mapping[str, frozenset[str]] = {
    TIME: frozenset({"time", "t", "timestamp", "zeit", "messzeit", "temps", "tiempo"}),
    "valve_v": frozenset({"valve", "command", "cmd", "control", "u", "ventil", "stellgroesse"}),
    "pressure_pa": frozenset({"pressure", "p", "druck", "pression", "presion"}),
    "position_m": frozenset(
        {"position", "pos", "displacement", "disp", "contraction", "stroke", "x", "weg", "hub",
         "encoder", "enc", "kontraktion", "auslenkung", "deplacement"}
    ),
    "force_n": frozenset({"force", "f", "kraft"}),
}  # fmt: skip
"""Words for a quantity, in the languages of many labs."""
_BESIDE = frozenset({
    "muscle", "muskel", "pam", "actuator", "measured", "meas", "gemessen", "actual", "act", "ist",
    "sensor", "channel", "ch", "ai", "ao", "signal", "value", "wert", "applied",
    "elapsed", "relative", "rel", "absolute", "abs", "absolut", "gauge", "internal", "inner",
    "voltage", "spannung", "since", "start", "cell", "load", "axial", "linear", "number", "no",
})  # fmt: skip
"""Words that change nothing."""
_OTHER = frozenset({
    "set", "setpoint", "sp", "soll", "sollwert", "target", "reference", "ref", "desired", "des",
    "demand", "demanded", "wanted", "error", "err", "fehler", "deviation", "supply", "tank",
    "source", "versorgung", "ambient", "atmospheric", "atmosphere", "model", "modelled",
    "simulated", "simulation", "sim", "estimate", "estimated", "est", "predicted", "mean", "max",
    "min", "std", "limit", "velocity", "speed", "rate", "initial", "dead", "delay", "step",
})  # fmt: skip
"""Words for another thing than the measured quantity."""
_OF_A_COMMAND = frozenset({"set", "setpoint", "sp", "soll", "demand", "desired", "reference"})
"""They do not rule out the valve's command."""
_BRACKETED = re.compile(r"(.*?)\s*[\[(](.+?)[\])]+\s*", re.DOTALL)
_SENSE_WORDS = r"(\S+\s+(?:g|gauge|rel|relative|a|abs|absolute))"
_FORMS = [
    _BRACKETED,
    *(
        re.compile(label + r"(?:\s*/\s*|\s*,\s*|\s+in\s+|[\s_]+)" + unit, re.I | re.DOTALL)
        for unit in (_SENSE_WORDS, r"(\S+)")
        for label in (r"(.*?)", r"(.*)")
    ),
]
_SPELLINGS = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "sekunden": "s", "msec": "ms",
    "milliseconds": "ms", "microseconds": "us", "minutes": "min", "volt": "V", "volts": "V",
    "millimeter": "mm", "millimetre": "mm", "micron": "um", "microns": "um", "inch": "in",
    "inches": "in", '"': "in", "newton": "N", "newtons": "N", "pascal": "Pa", "torr": "Torr",
    "mm hg": "mmHg", "in hg": "inHg", "kp/cm2": "kgf/cm2", "kg/cm2": "kgf/cm2", "kp": "kgf",
}  # fmt: skip
_CLOCK_FORM = re.compile(r"[\[(][dhmsyf:.,/ -]+[\])]", re.I)
"""As in `Time [hh:mm:ss]`: no unit, but the form of the cells."""
_LETTERS = str.maketrans(
    {"\xe4": "ae", "\xf6": "oe", "\xfc": "ue", "\xdf": "ss", "\xe9": "e", "\xf3": "o"}
)
_SENSE = re.compile(
    r"(\S+?|mm hg|in hg)[\s_(]*"
    r"(?:(g|gauge|gage|rel\.?|relative?|\N{LATIN SMALL LETTER U WITH DIAERESIS})"
    r"|(a|abs\.?|absolute?))\)?"
)


@cache
def read_unit(text: str) -> _Unit | None:
    """Return the quantity and unit that a text such as `[kPa abs]` names; None for another text."""
    plain = text.strip().strip("[]()").strip().lower()
    for sign, word in (("\N{MICRO SIGN}", "u"), ("\N{GREEK SMALL LETTER MU}", "u"),
                       ("\N{SUPERSCRIPT TWO}", "2"), ("^2", "2")):  # fmt: skip
        plain = plain.replace(sign, word)
    sense = _SENSE.fullmatch(plain)
    for spelt, gauge in ((plain, None), (sense and sense[1], sense and sense[2] is not None)):
        unit = _SPELLINGS.get(spelt or "", spelt or "").lower()
        for quantity, units in UNITS.items():
            found = next((name for name in units if name.lower() == unit), None)
            if found is not None and (gauge is None or quantity == "pressure_pa"):
                return _Unit(quantity, found, gauge)
    return None


def understand_header(name: str, unit: str = "") -> HeaderMeaning | None:
    """Return what a name says; `unit` is stated elsewhere, as in a line below the names.

    None if the words name none of our quantities, or another thing.
    """
    label, said, found = _split_unit(name, unit)
    words = _split_words(label)
    named = [quantity for quantity, its in _NAMES.items() if its & words]
    if found is not None and found.quantity in named:
        named = [found.quantity]
    if len(named) != 1:
        return None
    quantity = named[0]
    others = words - _NAMES[quantity]
    is_command = quantity == "valve_v"
    if others & (_OTHER - _OF_A_COMMAND if is_command else _OTHER):
        return None
    is_sure = others <= (_BESIDE | _OF_A_COMMAND if is_command else _BESIDE)
    is_gauge = _tell_gauge(found, words)
    if found is not None and found.quantity == quantity:
        return HeaderMeaning(quantity, found.unit, is_gauge, is_sure, said)
    return HeaderMeaning(quantity, "", is_gauge, is_sure, said) if is_sure else None


def _split_unit(name: str, unit: str) -> tuple[str, str, _Unit | None]:
    if unit:
        return _CLOCK_FORM.sub("", name), unit, read_unit(unit)
    for form in _FORMS:
        match = form.fullmatch(name.strip())
        if match is not None and (found := read_unit(match[2])) is not None:
            return match[1], match[2], found
    bracketed = _BRACKETED.fullmatch(name.strip())
    return (bracketed[1], bracketed[2], None) if bracketed else (name, "", None)


def _split_words(label: str) -> set[str]:
    """Return the words of a label in small letters; numbers count for nothing."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", label)
    return set(re.findall(r"[^\W\d_]+", spaced.lower().translate(_LETTERS)))


def _tell_gauge(found: _Unit | None, words: set[str]) -> bool | None:
    if found is not None and found.is_gauge is not None:
        return found.is_gauge
    if words & {"gauge", "relative", "rel"}:
        return True
    return False if words & {"absolute", "abs", "absolut"} else None


# The choice.

_Candidate = tuple[int, TableColumn, HeaderMeaning]
_Candidates = dict[str, list[_Candidate]]


def choose_by_header(table: MeasuredTable) -> ChosenColumns:
    """Return the columns whose headers state quantity and unit.

    Raise ImportRefused, with a map, where two columns may be meant, a header is not understood as
    a whole, a quantity is named without a unit that it has, or there is no time.
    """
    chosen = ChosenColumns([], [], {}, [])
    sure: _Candidates = {}
    asked: _Candidates = {}
    for number, column in enumerate(table.columns, 1):
        meaning = understand_column(column)
        if meaning is None:
            chosen.left_out[number] = _say_why(column)
        else:
            is_clear = meaning.is_sure and meaning.unit and not column.is_text
            kind = sure if is_clear else asked
            kind.setdefault(meaning.quantity, []).append((number, column, meaning))
    doubts = []
    for quantity in UNITS:
        columns, unsure = sure.get(quantity, []), asked.get(quantity, [])
        if plain := [one for one in columns if one[2].is_plain]:
            unsure = [*unsure, *(one for one in columns if not one[2].is_plain)]
            columns = plain
        if not columns:
            doubts += [_ask(quantity, column, meaning) for _, column, meaning in unsure]
            continue
        first = columns[0]
        for number, _, _ in unsure:
            chosen.left_out[number] = f"{quantity} is in {first[1].name!r}"
        rivals = [first]
        for one in columns[1:]:
            if quantity == TIME and _is_same_time(first, one):
                chosen.left_out[one[0]] = f"the same time as in column {first[0]}"
            else:
                rivals.append(one)
        if len(rivals) > 1:
            names = " and ".join(_quote(column.name) for _, column, _ in rivals)
            doubts.append(f"{names} may each be {quantity}")
        else:
            doubts += _settle(chosen, *first[1:])
    if doubts or not any(reading.quantity == TIME for reading in chosen.readings):
        raise ImportRefused(_refuse(table, doubts, chosen.readings, {**asked, **sure}))
    return chosen


def understand_column(column: TableColumn) -> HeaderMeaning | None:
    """Return what the names and the unit of a column say, see `understand_header`."""
    plain = parse_column_name(column.name) or parse_column_name(column.name, column.called)
    if plain is not None:
        is_gauge = plain.gauge if plain.quantity == "pressure_pa" else None
        return HeaderMeaning(plain.quantity, plain.unit, is_gauge, True, is_plain=True)
    return understand_header(column.called or column.name, column.unit)


def _say_why(column: TableColumn) -> str:
    if column.is_text:
        return column.says or "words, no numbers"
    return "its name says no quantity with its unit that pamctl reads"


def _is_same_time(one: _Candidate, other: _Candidate) -> bool:
    first, second = (c.values * UNITS[TIME][meaning.unit] for _, c, meaning in (one, other))
    return np.array_equal(first, second, equal_nan=True)


def _settle(chosen: ChosenColumns, column: TableColumn, meaning: HeaderMeaning) -> list[str]:
    """Add how a column is read; return a doubt for a pressure that may be gauge or absolute."""
    reading = ColumnReading(
        meaning.quantity, column.name, meaning.unit, gauge=bool(meaning.is_gauge)
    )
    if meaning.quantity == "pressure_pa" and meaning.is_gauge is None:
        lowest_pa = _find_lowest(reading, column)
        if lowest_pa < NEVER_ABSOLUTE_PA:
            sense = f"gauge, as an absolute one does not fall to {lowest_pa:.4g} Pa"
        elif OF_THE_AIR_PA[0] <= lowest_pa <= OF_THE_AIR_PA[1]:
            sense = f"absolute, as it falls to {lowest_pa:.4g} Pa, the atmosphere's"
        else:
            return [f"{_quote(column.name)} may be gauge or absolute"]
        chosen.warnings.append(f"{column.name} is taken as {sense}; if that is wrong, use --map")
        reading = ColumnReading(
            meaning.quantity, column.name, meaning.unit, gauge=sense.startswith("gauge")
        )
    chosen.readings.append(reading)
    chosen.columns.append(column)
    return []


def _find_lowest(reading: ColumnReading, column: TableColumn) -> float:
    values_pa = reading.to_si(column.values)
    values_pa = values_pa[np.isfinite(values_pa)]
    return float(np.quantile(values_pa, 0.001)) if len(values_pa) else np.nan


def _ask(quantity: str, column: TableColumn, meaning: HeaderMeaning) -> str:
    name = _quote(column.name)
    if column.is_text:
        return f"{name} may be {quantity}, but holds {column.says or 'words'}"
    if meaning.unit:
        return f"{name} may be {quantity}, or something else"
    if not meaning.said_unit:
        return f"{name} states no unit for {quantity}"
    units = ", ".join(UNITS[quantity])
    return (
        f"{name} is in {meaning.said_unit!r}, which is no unit of {quantity} ({units}): `gain` and "
        f"`offset` in the map turn it into one of them"
    )


# The map that a refusal shows.


def _refuse(
    table: MeasuredTable,
    doubts: Sequence[str],
    readings: Iterable[ColumnReading],
    candidates: Mapping[str, Sequence[_Candidate]],
) -> str:
    doubts = list(doubts)
    given = {reading.quantity: reading for reading in readings}
    if TIME not in given and TIME not in candidates:
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
    for quantity in UNITS:
        if quantity in given:
            lines.append(write_map_line(table, given[quantity]))
            continue
        usable = [one for one in candidates.get(quantity, ()) if not one[1].is_text]
        for index, (_, column, meaning) in enumerate(usable):
            lines.append(_propose(table, quantity, column, meaning, is_first=not index))
        if quantity == TIME and not usable:
            lines.append(_propose_time(table, table.columns))
    doubts += table.notes
    known = {id(column) for part in candidates.values() for _, column, _ in part}
    others = [c.name for c in table.columns if id(c) not in known and not c.is_text]
    lines += [f"# other columns: {', '.join(map(_quote, others[:20]))}"] if others else []
    lines += [table.mend] if table.mend else []
    return show_map("; ".join(doubts) + "; say which with --map FILE, such as:", "\n".join(lines))


def show_map(doubt: str, text: str) -> str:
    """Return a refusal with the text of a map below it."""
    return "\n".join([doubt, *(f"  {line}" for line in text.splitlines())])


def write_map_line(table: MeasuredTable, reading: ColumnReading, remark: str = "") -> str:
    """Return a reading as the line of a map that says the same."""
    parts = [f"column: {_name_for_map(table, str(reading.column))}", f"unit: {reading.unit}"]
    if reading.quantity == "pressure_pa":
        parts.append(f"gauge: {str(reading.gauge).lower()}")
    parts += [f"gain: {reading.gain!r}"] if reading.gain != 1.0 else []
    parts += [f"offset: {reading.offset!r}"] if reading.offset else []
    parts += [f"shift_s: {reading.shift_s!r}"] if reading.shift_s else []
    return f"{_KEYS[reading.quantity]}: {{{', '.join(parts)}}}" + (remark and f"  # {remark}")


def _propose(
    table: MeasuredTable,
    quantity: str,
    column: TableColumn,
    meaning: HeaderMeaning,
    *,
    is_first: bool,
) -> str:
    """Return a line for a column in doubt; a comment where the user must fill something in."""
    if quantity == TIME and not meaning.unit and is_first:
        return _propose_time(table, [column])
    number = table.columns.index(column) + 1 if _is_repeated(table, column.name) else None
    name: str | int = column.name if number is None else number
    gauge = meaning.is_gauge
    unit = meaning.unit or next(iter(UNITS[quantity]))
    reading = ColumnReading(quantity, str(name), unit, gauge=bool(gauge))
    remark = ""
    if quantity == "pressure_pa" and gauge is None and meaning.unit:
        is_low = _find_lowest(reading, column) < NEVER_ABSOLUTE_PA
        reading = ColumnReading(quantity, str(name), unit, gauge=is_low)
        remark = f"or gauge: {str(not is_low).lower()}; the file does not say"
    line = write_map_line(table, reading, remark)
    if not meaning.unit:
        per = f" per {meaning.said_unit}" if meaning.said_unit else ""
        return f"# {line}  # its unit is not known: write unit, or gain ({unit}{per}) and offset"
    return line if is_first else f"# {line}  # or this one"


def _propose_time(table: MeasuredTable, columns: Sequence[TableColumn]) -> str:
    """Return the line for the first column that always rises, else for a rate."""
    for column in columns:
        step = np.diff(column.values)
        if len(step) and bool((step > 0.0).all()):
            period = float(np.median(step))
            unit = "s" if period < 0.5 else "ms" if period < 1e3 else "us" if period < 1e6 else "ns"
            reading = ColumnReading(TIME, column.name, column.unit or unit)
            remark = "" if column.unit else f"a row every {period:g}: is it in {unit}?"
            return write_map_line(table, reading, remark)
    return "# time: {rate_hz: 1000}  # no column always rises: write the rows per second"


def _is_repeated(table: MeasuredTable, name: str) -> bool:
    return sum(column.name == name for column in table.columns) > 1


def _name_for_map(table: MeasuredTable, name: str) -> str:
    if name.isdecimal() and not any(column.name == name for column in table.columns):
        return name
    return _quote(name)


def _quote(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
