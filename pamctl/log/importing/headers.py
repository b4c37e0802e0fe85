"""What a header says of its column: `Pressure [bar]`, `Kolbenweg/mm`, `position_mm`.

The unit says which quantity a column can hold; the words must agree. A word that is not known
leaves a doubt, a word for something else (a set point, the supply) rules the column out.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from enum import IntEnum
from functools import cache
from typing import NamedTuple

_UNITS_OF_SUFFIX: Mapping[str, Mapping[str, float]] = {
    "_n_s_per_m": {"N s/m": 1.0, "N s/mm": 1e3, "kN s/m": 1e3, "N s/cm": 1e2},
    "_n_per_m": {"N/m": 1.0, "N/mm": 1e3, "N/cm": 1e2, "kN/m": 1e3},
    "_j_per_kg_k": {"J/(kg K)": 1.0},
    "_m2_per_v": {"m2/V": 1.0, "mm2/V": 1e-6},
    "_per_m": {"1/m": 1.0, "1/mm": 1e3},
    "_kg": {"kg": 1.0, "g": 1e-3, "lb": 0.45359237, "t": 1e3},
    "_m3": {"m3": 1.0, "l": 1e-3, "dm3": 1e-3, "ml": 1e-6, "cm3": 1e-6, "mm3": 1e-9},
    "_m2": {"m2": 1.0, "cm2": 1e-4, "mm2": 1e-6},
    "_pa": {
        "Pa": 1.0,
        "kPa": 1e3,
        "MPa": 1e6,
        "hPa": 1e2,
        "bar": 1e5,
        "mbar": 1e2,
        "psi": 6894.757293168,
        "atm": 101325.0,
        "Torr": 101325.0 / 760.0,
        "mmHg": 133.322387415,
        "inHg": 3386.388640341,
        "kgf/cm2": 98066.5,
    },
    "_k": {"K": 1.0},
    "_m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "in": 25.4e-3},
    "_n": {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605, "kgf": 9.80665},
    "_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "_v": {"V": 1.0, "mV": 1e-3},
}
"""The first suffix that ends a name counts."""


def find_units(name: str) -> Mapping[str, float]:
    """Return the units of a quantity with their SI values; empty for a plain number."""
    return next((units for end, units in _UNITS_OF_SUFFIX.items() if name.endswith(end)), {})


TIME = "t_s"
QUANTITIES = (TIME, "valve_v", "pressure_pa", "position_m", "force_n")
UNITS: Mapping[str, Mapping[str, float]] = {name: find_units(name) for name in QUANTITIES}
"""SI value of each unit of a quantity."""

_WORDS = {
    "t": TIME,
    "time": TIME,
    "valve": "valve_v",
    "pressure": "pressure_pa",
    "pressure_gauge": "pressure_pa",
    "pressure_absolute": "pressure_pa",
    "position": "position_m",
    "displacement": "position_m",
    "force": "force_n",
}
_NAME = re.compile(rf"({'|'.join(sorted(_WORDS, key=len, reverse=True))})_([a-z]+)")


class SaidQuantity(NamedTuple):
    """What a name, or a unit beside it, says of a column."""

    quantity: str
    unit: str
    is_gauge: bool | None
    """Of a pressure; None where nothing says it."""


def parse_column_name(name: str) -> SaidQuantity | None:
    """Return what a name such as `position_mm` states; None if it does not state it so."""
    match = _NAME.fullmatch(name.strip().lower())
    if match is None:
        return None
    word, suffix = match.groups()
    quantity = _WORDS[word]
    unit = next((unit for unit in UNITS[quantity] if unit.lower() == suffix), None)
    is_gauge = word == "pressure_gauge" if quantity == "pressure_pa" else None
    return None if unit is None else SaidQuantity(quantity, unit, is_gauge)


RADIANS = {"deg": 0.0174533, "degree": 0.0174533, "degrees": 0.0174533,
           "\N{DEGREE SIGN}": 0.0174533, "rad": 1.0, "radian": 1.0, "radians": 1.0}  # fmt: skip
"""Radians in a unit of an angle: times the lever's length they make a position."""


def explain_angle(unit: str) -> str:
    """Return how an angle becomes a position; nothing for a unit of no angle."""
    radians = RADIANS.get(unit.lower(), 0.0)
    size = "1" if radians == 1.0 else f"{radians:g} (pi / 180)"
    said = "an angle: with `unit: m`, its gain is the radius of the pulley or lever in m times"
    return f"{said} {size}" if radians else ""


CURRENTS = frozenset({"a", "amp", "amps", "ampere", "amperes"})
"""Units of a motor's current in lower case; mA are those of a valve or of a sensor."""

NEED_A_GAIN = CURRENTS | RADIANS.keys() | {"count", "counts", "cnt", "inc", "increments", "ticks"}
"""In lower case: no rig is described in them, and only a gain makes a quantity of them."""


class Certainty(IntEnum):
    """How much a header says of its quantity."""

    NOTHING = 0
    GUESS = 1
    """Its unit or one of its words is of this quantity, and the others are not known."""
    DOUBT = 2
    """It names the quantity, beside a word that is not known."""
    SURE = 3
    """Every word is understood."""
    PLAIN = 4
    """It is pamctl's own name for the quantity and its unit, such as `valve_v`."""


class Header(NamedTuple):
    """What a header says of its column."""

    quantity: str
    """Empty where it says nothing."""
    unit: str
    """Empty where it states none that this quantity has."""
    is_gauge: bool | None
    """Of a pressure; None if the header does not say it."""
    certainty: Certainty
    said_unit: str = ""
    """What stands in the place of the unit."""
    others: frozenset[str] = frozenset()
    """The words by which it says that it is another thing."""
    measures: str = ""
    """The quantity that has the stated unit, whatever the words say; empty if it may be no unit."""


NAMES: Mapping[str, frozenset[str]] = {
    TIME: frozenset({
        "time", "t", "timestamp", "zeit", "messzeit", "uhrzeit", "temps", "tiempo", "tempo",
    }),
    "valve_v": frozenset({
        "valve", "command", "cmd", "control", "u", "ao", "ventil", "stell", "stellgroesse",
        "valvula", "valvola", "vanne", "distributeur", "mando", "comando", "commande",
    }),
    "pressure_pa": frozenset({
        "pressure", "p", "pm", "druck", "ueberdruck", "pression", "presion", "pressione", "pressao",
    }),
    "position_m": frozenset({
        "position", "pos", "displacement", "disp", "contraction", "stroke", "x", "weg", "hub",
        "lage", "encoder", "enc", "kontraktion", "auslenkung", "deplacement", "angle", "winkel",
        "posicion", "posizione", "posicao", "desplazamiento", "spostamento", "deslocamento",
        "course", "corsa", "carrera",
    }),
    "force_n": frozenset({"force", "f", "fm", "kraft", "thrust", "fuerza", "forza", "forca"}),
}  # fmt: skip
"""Words for a quantity, in the languages of many labs."""
_OF_A_VALVE = NAMES["valve_v"] - frozenset({"command", "cmd", "control", "u", "stell", "commande"})
"""Words that no motor has."""
_SENSES: Mapping[bool, frozenset[str]] = {
    True: frozenset({
        "gauge", "gage", "rel", "relative", "relativ", "relativa", "uberdruck", "ueberdruck",
        "manometric", "manometrica", "manometrique",
    }),
    False: frozenset({
        "abs", "absolute", "absolut", "absolutdruck", "absolu", "absolue", "absoluta", "assoluta",
    }),
}  # fmt: skip
"""Words for a gauge pressure, and for an absolute one."""
_SENSES_OF_A_UNIT = {True: _SENSES[True] | {"g", "ue"}, False: _SENSES[False] | {"a"}}
"""Beside a unit: `bar g`, `bar \xfc`, `kPa a`."""
_BESIDE = _SENSES[True] | _SENSES[False] | frozenset({
    "muscle", "muskel", "pam", "actuator", "aktor", "measured", "meas", "gemessen", "actual", "act",
    "ist", "sensor", "channel", "ch", "ai", "signal", "value", "wert", "applied", "feedback",
    "elapsed", "of", "day", "clock", "internal", "inner",
    "voltage", "spannung", "since", "start", "cell", "load", "axial", "linear", "number", "no",
    "chamber", "vessel", "cylinder", "piston", "rod", "carriage", "slide", "axis", "drive", "motor",
    "joint", "gelenk", "servo", "tension", "cote", "fond", "tige",
    "bogen", "chambre", "camara", "camera", "muscolo", "musculo", "cilindro", "verin", "pistone",
    "asse", "axe", "eje", "del", "della",
    "kammer", "behaelter", "zylinder", "kolben", "stange", "schlitten", "achse", "antrieb", "mess",
    "proportional", "prop", "laser", "lvdt", "transducer", "aufnehmer", "zelle", "last",
})  # fmt: skip
"""Words that change nothing: what is measured, and with what."""
OTHER = frozenset({
    "set", "setpoint", "sp", "soll", "sollwert", "target", "reference", "ref", "desired", "des",
    "demand", "demanded", "wanted", "error", "err", "fehler", "deviation", "supply", "tank",
    "source", "versorgung", "ambient", "atmospheric", "atmosphere", "model", "modelled",
    "simulated", "simulation", "sim", "estimate", "estimated", "est", "predicted", "mean", "max",
    "min", "std", "limit", "velocity", "speed", "rate", "initial", "dead", "delay", "step",
    "status", "state", "flag", "flags", "mode",
    "consigne", "consigna", "riferimento", "referencia", "alimentation", "alimentacion",
    "alimentazione", "vitesse", "velocidad", "velocita", "errore", "erreur",
})  # fmt: skip
"""Words for another thing than the measured quantity."""
OF_A_COMMAND = frozenset({
    "set", "setpoint", "sp", "soll", "sollwert", "demand", "desired", "reference",
})  # fmt: skip
"""They do not rule out the valve's command; in volts, and of nothing else, they may be it."""
_BRACKETED = re.compile(r"(.*?)\s*[\[(](.+?)[\])]+\s*", re.DOTALL)
_ANY_SENSE = "|".join(sorted(_SENSES_OF_A_UNIT[True] | _SENSES_OF_A_UNIT[False]))
_SENSE_WORDS = rf"(\S+\s+(?:{_ANY_SENSE}))"
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
_SUBSCRIPTS = {"s", "us", "ms", "min", "v", "m", "in", "n"}
"""They end a name for another reason as often as for a unit: `p_m`, `P_in`, `x_min`."""
_CLOCK_FORM = re.compile(r"[\[(][dhmsyf:.,/ -]+[\])]", re.I)
"""As in `Time [hh:mm:ss]`: no unit, but the form of the cells."""
_UMLAUTS = str.maketrans({
    "\xe4": "ae", "\xf6": "oe", "\xfc": "ue", "\xdf": "ss",
    "\xc4": "AE", "\xd6": "OE", "\xdc": "UE",
})  # fmt: skip
_SENSE = re.compile(rf"(\S+?|mm hg|in hg)[\s_(]*({_ANY_SENSE})\.?\)?")


def _drop_accents(text: str) -> str:
    """Return a text without accents; an umlaut becomes two letters."""
    parts = unicodedata.normalize("NFD", unicodedata.normalize("NFC", text).translate(_UMLAUTS))
    return "".join(letter for letter in parts if not unicodedata.combining(letter))


@cache
def read_unit(text: str) -> SaidQuantity | None:
    """Return the quantity and unit that a text such as `[kPa abs]` names; None for another text."""
    plain = _drop_accents(text).strip().strip("[]()").strip().lower()
    for sign, word in (("\N{MICRO SIGN}", "u"), ("\N{GREEK SMALL LETTER MU}", "u"),
                       ("\N{SUPERSCRIPT TWO}", "2"), ("^2", "2")):  # fmt: skip
        plain = plain.replace(sign, word)
    sense = _SENSE.fullmatch(plain)
    is_gauge = sense and sense[2] in _SENSES_OF_A_UNIT[True]
    for spelt, gauge in ((plain, None), (sense and sense[1], is_gauge)):
        unit = _SPELLINGS.get(spelt or "", spelt or "").lower()
        for quantity, units in UNITS.items():
            found = next((name for name in units if name.lower() == unit), None)
            if found is not None and (gauge is None or quantity == "pressure_pa"):
                return SaidQuantity(quantity, found, gauge)
    return None


@cache
def read_header(name: str, called: str = "", unit: str = "") -> Header:
    """Return what the names of a column say; `unit` is stated apart, as in a line below them."""
    plain = parse_column_name(name) or parse_column_name(called)
    if plain is not None:
        return Header(*plain, Certainty.PLAIN, measures=plain.quantity)
    label, said, found = split_unit(called or name, unit)
    words = split_words(label)
    others = frozenset(words & OTHER)
    named = [quantity for quantity, its in NAMES.items() if its & words]
    is_set_point = bool(others) and others <= OF_A_COMMAND - {"reference"}  # of a sensor's bridge
    if found and found.quantity == "valve_v" and not named and is_set_point:
        named = ["valve_v"]
    is_apart = bool(unit) or (called or name).endswith((")", "]"))
    is_unit = found and (is_apart or found.quantity in named or said.lower() not in _SUBSCRIPTS)
    measures = found.quantity if found and is_unit else ""
    if said.lower() in CURRENTS and not (others or words & _OF_A_VALVE):
        return Header("force_n", "", None, Certainty.GUESS, said)
    is_alone = not named and bool(words) and words <= _BESIDE
    # `Load cell (N)`, `ist_mm`: volts may be those of any sensor, other units tell.
    if found and (found.quantity in named or (is_alone and found.quantity != "valve_v")):
        quantities = [found.quantity]
    else:
        quantities = named
    if len(quantities) == 1:
        quantity = quantities[0]
        of_a_command = OF_A_COMMAND if quantity == "valve_v" else frozenset()
        stated = found.unit if found and found.quantity == quantity else ""
        is_sure = bool(words & NAMES[quantity] or is_alone)
        is_sure &= words - NAMES[quantity] <= _BESIDE | of_a_command
        if not (words - NAMES[quantity]) & (OTHER - of_a_command) and (stated or is_sure):
            certainty = Certainty.SURE if is_sure else Certainty.DOUBT
            gauge = tell_gauge(found, words)
            return Header(quantity, stated, gauge, certainty, said, others, measures)
    if not others and len(named) < 2:
        if found and found.quantity in (named or [found.quantity]):
            gauge = tell_gauge(found, words)
            return Header(*found[:2], gauge, Certainty.GUESS, said, measures=measures)
        if named or said.lower() in RADIANS:
            return Header((*named, "position_m")[0], "", None, Certainty.GUESS, said)
    return Header("", found.unit if found else "", None, Certainty.NOTHING, said, others, measures)


def split_words(label: str) -> set[str]:
    """Return the words of a name; numbers count for nothing."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", _drop_accents(label)).lower()
    return {part for word in re.findall(r"[^\W\d_]+", spaced) for part in _split_compound(word)}


def _split_compound(word: str) -> tuple[str, ...]:
    """Return the two known words that a word such as `kolbenposition` joins, or the word."""
    known = _BESIDE.union(OTHER, *NAMES.values())
    if word not in known:
        for at in range(3, len(word) - 2):
            if word[at:] in known and {word[:at], word[:at].removesuffix("s")} & known:
                return word[:at] if word[:at] in known else word[: at - 1], word[at:]
    return (word,)


def split_unit(name: str, unit: str) -> tuple[str, str, SaidQuantity | None]:
    """Return the label of a name, the unit that it states, and what has this unit."""
    if unit:
        return _CLOCK_FORM.sub("", name), unit, read_unit(unit)
    name = _drop_accents(name)
    for form in _FORMS:
        match = form.fullmatch(name.strip())
        found = read_unit(match[2]) if match else None
        if match and (found or match[2].lower() in (*RADIANS, "ma")):
            return match[1], match[2], found
    for word in reversed([*re.finditer(r"(?<=[\s_])[^\s_]+(?=[\s_])", name)]):
        found, rest = read_unit(word[0]), f"{name[: word.start()]} {name[word.end() :]}"
        if found and NAMES[found.quantity] & split_words(rest):  # `p_bar_abs`, `pos_mm_raw`
            return rest, word[0], found
    bracketed = _BRACKETED.fullmatch(name.strip())
    return (bracketed[1], bracketed[2], None) if bracketed else (name, "", None)


def tell_gauge(found: SaidQuantity | None, words: set[str]) -> bool | None:
    """Return whether a pressure is a gauge one, by its unit or a word; None if neither tells."""
    if found is not None and found.is_gauge is not None:
        return found.is_gauge
    return next((is_gauge for is_gauge, its in _SENSES.items() if its & words), None)
