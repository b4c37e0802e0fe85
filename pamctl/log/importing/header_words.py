"""What a header says of its column: quantity, unit, gauge or absolute.

`Pressure [bar]`, `Muscle pressure (kPa abs)`, `Weg/mm`, `position_mm`. The unit says which quantity
a column can hold; the words must agree. A word that is not known leaves a doubt, and a word for
something else (a set point, the supply) rules the column out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

from pamctl.log.importing.measured_table import TableColumn
from pamctl.log.importing.quantities import TIME, UNITS, SaidQuantity, parse_column_name


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


_NAMES: Mapping[str, frozenset[str]] = {
    TIME: frozenset({"time", "t", "timestamp", "zeit", "messzeit", "uhrzeit", "temps", "tiempo"}),
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
def read_unit(text: str) -> SaidQuantity | None:
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
                return SaidQuantity(quantity, found, gauge)
    return None


def understand_column(column: TableColumn) -> HeaderMeaning | None:
    """Return what the names and the unit of a column say, see `understand_header`."""
    plain = parse_column_name(column.name) or parse_column_name(column.called)
    if plain is not None:
        return HeaderMeaning(*plain, is_sure=True, is_plain=True)
    return understand_header(column.called or column.name, column.unit)


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


def _split_unit(name: str, unit: str) -> tuple[str, str, SaidQuantity | None]:
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


def _tell_gauge(found: SaidQuantity | None, words: set[str]) -> bool | None:
    if found is not None and found.is_gauge is not None:
        return found.is_gauge
    if words & {"gauge", "relative", "rel"}:
        return True
    return False if words & {"absolute", "abs", "absolut"} else None
