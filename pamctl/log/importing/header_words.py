"""Understand headers as people write them: `Pressure [bar]`, `Muscle pressure (kPa abs)`, `Weg/mm`.

The unit says which quantity a column can hold; the words must agree. A word that is not known
leaves a doubt, and a word for something else (a set point, the supply) rules the column out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

from pamctl.log.importing.quantities import TIME, UNITS


class HeaderMeaning(NamedTuple):
    """What a header says of its column."""

    quantity: str
    unit: str
    is_gauge: bool | None
    """Of a pressure; None if the header does not say it."""
    is_sure: bool
    """Whether every word is understood."""


class _Unit(NamedTuple):
    quantity: str
    unit: str
    is_gauge: bool | None


_NAMES: Mapping[str, frozenset[str]] = {
    TIME: frozenset({"time", "t", "timestamp", "zeit", "temps", "tiempo"}),
    "valve_v": frozenset({"valve", "command", "cmd", "control", "u", "ventil", "stellgroesse"}),
    "pressure_pa": frozenset({"pressure", "p", "druck", "pression", "presion"}),
    "position_m": frozenset(
        {"position", "pos", "displacement", "disp", "contraction", "stroke", "x", "weg", "hub",
         "kontraktion", "auslenkung", "deplacement"}
    ),
    "force_n": frozenset({"force", "f", "kraft"}),
}  # fmt: skip
"""Words for a quantity, in the languages of many labs."""
_BESIDE = frozenset({
    "muscle", "muskel", "pam", "actuator", "measured", "meas", "gemessen", "actual", "act", "ist",
    "sensor", "encoder", "channel", "ch", "ai", "ao", "signal", "value", "wert", "applied",
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
_MARK = r"(.*)(?:\s*/\s*|\s*,\s*|\s+in\s+|[\s_]+)"
_WITH_SENSE = re.compile(
    _MARK + r"(\S+\s+(?:g|gauge|rel|relative|a|abs|absolute))", re.I | re.DOTALL
)
_APART = re.compile(_MARK + r"(\S+)", re.DOTALL)
_SPELLINGS = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "sekunden": "s", "msec": "ms",
    "milliseconds": "ms", "microseconds": "us", "minutes": "min", "volt": "V", "volts": "V",
    "millimeter": "mm", "millimetre": "mm", "micron": "um", "microns": "um", "inch": "in",
    "inches": "in", '"': "in", "newton": "N", "newtons": "N", "pascal": "Pa",
}  # fmt: skip
_SENSE = re.compile(
    r"(pa|kpa|mpa|bar|mbar|psi)[\s_(]*"
    r"(?:(g|gauge|gage|rel\.?|relative?|\N{LATIN SMALL LETTER U WITH DIAERESIS})"
    r"|(a|abs\.?|absolute?))\)?"
)


@cache
def read_unit(text: str) -> _Unit | None:
    """Return the quantity and unit that a text such as `[kPa abs]` names; None for another text."""
    plain = text.strip().strip("[]()").strip().lower()
    plain = plain.replace("\N{MICRO SIGN}", "u").replace("\N{GREEK SMALL LETTER MU}", "u")
    sense = _SENSE.fullmatch(plain)
    if sense is not None:
        plain = sense[1]
    plain = _SPELLINGS.get(plain, plain).lower()
    for quantity, units in UNITS.items():
        for unit in units:
            if unit.lower() == plain:
                return _Unit(quantity, unit, None if sense is None else sense[2] is not None)
    return None


def understand_header(name: str, unit: str = "") -> HeaderMeaning | None:
    """Return what a name says; `unit` is stated elsewhere, as in a line below the names.

    None if there is no unit, or the words name none of our quantities.
    """
    label, found = _split_unit(name, unit)
    if found is None:
        return None
    words = _split_words(label)
    named = {quantity for quantity, its in _NAMES.items() if its & words}
    if found.quantity not in named:
        return None
    others = words - _NAMES[found.quantity]
    barring = _OTHER - _OF_A_COMMAND if found.quantity == "valve_v" else _OTHER
    if others & barring:
        return None
    harmless = _BESIDE | (_OF_A_COMMAND if found.quantity == "valve_v" else set())
    return HeaderMeaning(found.quantity, found.unit, _tell_gauge(found, words), others <= harmless)


def _split_unit(name: str, unit: str) -> tuple[str, _Unit | None]:
    if unit:
        return name, read_unit(unit)
    for form in (_BRACKETED, _WITH_SENSE, _APART):
        match = form.fullmatch(name.strip())
        if match is not None and (found := read_unit(match[2])) is not None:
            return match[1], found
    return name, None


def _split_words(label: str) -> set[str]:
    """Return the words of a label in small letters; numbers count for nothing."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", label)
    return {word for word in re.findall(r"[^\W\d_]+", spaced.lower()) if word}


def _tell_gauge(found: _Unit, words: set[str]) -> bool | None:
    if found.is_gauge is not None:
        return found.is_gauge
    if words & {"gauge", "relative", "rel"}:
        return True
    return False if words & {"absolute", "abs", "absolut"} else None
