"""A plant file from a datasheet: the numbers to give, in which units, and the file's text.

Numbers are read as datasheets have them: `200 mm`, `6 bar gauge`, `25 mm bore`, `350 l/min`. A
number without a unit is in SI. The suffix of a setting's name says what it measures. The list of
numbers follows the settings: one that is added there is in it, with its own description.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import TypeAdapter
from pydantic.fields import FieldInfo

from pamctl.exit_codes import ExitCode
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import AXIS, PlantSettings
from pamctl.plant.paper import ROOM_K, MuscleParameters
from pamctl.settings.resolve import RawSettings, validate_settings
from pamctl.settings.yaml12 import dump_yaml
from pamctl.units import find_units

_LENGTHS = find_units("length_m")
_NUMBER = re.compile(r"\s*([-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
_THOUSAND = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
"""What is read in two ways: a comma between thousands, or before a fraction."""
_DEGREES = ("deg", "degree", "degrees", "\N{DEGREE SIGN}")

NOMINAL_UPSTREAM_PA, NOMINAL_DOWNSTREAM_PA = 7e5, 6e5
"""Where datasheets state a valve's nominal flow: from 6 to 5 bar gauge."""
NORMAL_AIR_KG_PER_M3 = 1.185
"""Air of ISO 6358's reference: 20 degC, 100 kPa, 65 % humidity."""
NORMAL_K = 293.15
FULL_COMMAND_V = 5.0


class DatasheetError(Exception):
    """A number cannot be read, or cannot be right. The message says what would do."""

    exit_code = ExitCode.USAGE


def list_units(name: str) -> str:
    """Name the units in which a setting may be given, with the other ways to give it."""
    others = _OTHER_WAYS.get(name.split(".")[-1], "")
    known = ", ".join(find_units(name))
    return f"{known}{', ' if known and others else ''}{others}" or "a plain number"


_OTHER_WAYS = {
    "tank_pressure_pa": "each with `gauge` or `absolute`",
    "braid_length_m": "or `23 deg`, the braid's angle to the axis at rest",
    "braid_turns": "a number, or `13 mm diameter`, the braid's diameter at rest",
    "area_m2": "or `25 mm bore`",
    "cylinder_area_m2": "or `25 mm bore`",
    "valve_gain_m2_per_v": "or `350 l/min`, the nominal flow at full opening",
    "temperature_k": "or `20 C`",
}


def read_quantity(name: str, text: str, known: Mapping[str, float]) -> float:
    """Return a setting in SI from a text; `known` holds the settings that were read before.

    Raise DatasheetError.
    """
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise DatasheetError(f"{name}: {text!r} is no number; give {list_units(name)}")
    if _THOUSAND.fullmatch(match[1]):
        both = match[1].replace(",", ""), match[1].replace(",", ".")
        raise DatasheetError(
            f"{name}: {match[1]} may be {both[0]} or {both[1]}: write one of these"
        )
    number = float(match[1].replace(",", "."))
    if not math.isfinite(number):
        raise DatasheetError(f"{name}: {text!r} is too large")
    words = match[2].split()
    plain = name.split(".")[-1]
    special = _SPECIAL.get(plain)
    value = special(number, words, known) if special else None
    if value is None:
        value = number * _factor(name, " ".join(words))
    return value


def _factor(name: str, unit: str) -> float:
    units = find_units(name)
    if not unit:
        return 1.0
    spelt = {_squeeze(known): factor for known, factor in units.items()}
    if _squeeze(unit) not in spelt:
        raise DatasheetError(f"{name}: {unit!r} is none of its units; give {list_units(name)}")
    return spelt[_squeeze(unit)]


def _squeeze(unit: str) -> str:
    return re.sub(r"[\s*^\N{MIDDLE DOT}]", "", unit.replace("\N{SUPERSCRIPT TWO}", "2"))


def _read_pressure(number: float, words: list[str], known: Mapping[str, float]) -> float | None:
    if not words:
        return None
    sense = words[-1].strip("().").lower()
    is_gauge = sense in ("gauge", "g", "barg")
    if not is_gauge and sense not in ("absolute", "abs", "a"):
        raise DatasheetError(
            f"tank_pressure_pa: {number:g} {' '.join(words)} may be gauge or absolute: write "
            f"`{number:g} {words[0]} gauge` (above the atmosphere) or `... absolute`"
        )
    pressure_pa = number * _factor("tank_pressure_pa", " ".join(words[:-1]) or "Pa")
    return pressure_pa + known["atmospheric_pressure_pa"] if is_gauge else pressure_pa


def _read_temperature(number: float, words: list[str], known: Mapping[str, float]) -> float | None:
    del known
    celsius = words and "".join(words).lstrip("\N{DEGREE SIGN}").lower() in ("c", "degc")
    return number + 273.15 if celsius else None


def _read_braid_length(number: float, words: list[str], known: Mapping[str, float]) -> float | None:
    """Return b of L_0 = b cos(theta)."""
    if not words or words[0] not in _DEGREES:
        return None
    if not 0.0 < number < 54.7:
        raise DatasheetError(
            f"braid_length_m: a braid at {number:g} deg does not contract when filled; "
            "its angle to the axis lies between 0 and 54.7 deg"
        )
    return known["rest_length_m"] / math.cos(math.radians(number))


def _read_braid_turns(number: float, words: list[str], known: Mapping[str, float]) -> float | None:
    """Return n of n pi D = b sin(theta)."""
    if not words:
        return None
    unit = words[0]
    diameter_m = number * _factor("diameter_m", unit)
    length_m, braid_m = known["rest_length_m"], known["braid_length_m"]
    if diameter_m <= 0.0 or braid_m <= length_m:
        raise DatasheetError("braid_turns: the diameter, and b beyond L_0, must be above 0")
    return math.sqrt(braid_m**2 - length_m**2) / (math.pi * diameter_m)


def _read_area(number: float, words: list[str], known: Mapping[str, float]) -> float | None:
    """Return the area of a bore; the sign says where pressure pushes."""
    del known
    if not words or words[0] not in _LENGTHS:
        return None
    if words[1:] not in (["bore"], ["diameter"]):
        raise DatasheetError(
            f"area_m2: {number:g} {words[0]} is a length; write `{number:g} {words[0]} bore`"
        )
    return math.copysign(0.25 * math.pi * (number * _LENGTHS[words[0]]) ** 2, number)


def _read_valve_gain(number: float, words: list[str], known: Mapping[str, float]) -> float | None:
    """Return K_Av of a nominal flow, by the model's own orifice (Eq. 8)."""
    unit = "".join(words).lower()
    if unit not in ("l/min", "nl/min", "lpm", "l/minanr"):
        return None
    from pamctl.plant.paper import orifice_flow
    from pamctl.plant.parameters import parameters_of

    del known
    air = parameters_of({"temperature_k": NORMAL_K}).paper
    flow = orifice_flow(air, NOMINAL_UPSTREAM_PA, NOMINAL_DOWNSTREAM_PA)
    return number * 1e-3 / 60.0 * NORMAL_AIR_KG_PER_M3 / (FULL_COMMAND_V * flow)


_SPECIAL = {
    "tank_pressure_pa": _read_pressure,
    "temperature_k": _read_temperature,
    "braid_length_m": _read_braid_length,
    "braid_turns": _read_braid_turns,
    "area_m2": _read_area,
    "cylinder_area_m2": _read_area,
    "valve_gain_m2_per_v": _read_valve_gain,
}


# --- the numbers of an actuator ------------------------------------------------------------------

_OF_AIR = {
    "tank_pressure_pa", "gas_constant_j_per_kg_k", "temperature_k", "heat_capacity_ratio",
    "valve_gain_m2_per_v",
}  # fmt: skip
_OF_BRAID = {
    "rest_length_m", "braid_length_m", "braid_turns", "kinetic_friction_per_m", "braid_count",
    "braid_contact_area_m2",
}  # fmt: skip
_OF_MOTION = {*AXIS}
_NOT_OF = {
    "muscle": set(),
    "direct": _OF_AIR | _OF_BRAID,
    "chamber": _OF_BRAID | _OF_MOTION,
    "cylinder": _OF_BRAID,
}
"""Numbers that mean nothing to an actuator."""
_NO_DEFAULT = {
    "direct": _OF_MOTION,
    "chamber": {"chamber_volume_m3"},
    "cylinder": {"cylinder_area_m2", "cylinder_volume_m3", "stroke_m", *_OF_MOTION},
}
"""Numbers for which no other rig's value is a guess."""
_OPTIONAL = {"direct": {"drive_n_per_v"}, "muscle": {"stroke_m"}}
"""Numbers that only `run` and `tune` need, or that only some rigs have."""
_DEFAULTS = {"temperature_k": ROOM_K}
"""Where the paper's number is no guess for a rig of one's own."""
_LOAD = ("external_load",)
_FRICTION = ("return_friction", "braid_drag")
_EFFECTS = {"muscle": (*_LOAD, *_FRICTION), "cylinder": _LOAD, "direct": ("piston",)}
"""Effects that are part of an actuator, where the catalogue has them."""
_FIRST = ("atmospheric_pressure_pa",)
"""A gauge pressure needs it."""


@dataclass(frozen=True)
class PlantQuestion:
    """One number of a plant file."""

    name: str
    """Dotted for a number of an effect."""
    meaning: str
    units: str
    default: float | None
    """None where it must be given."""
    is_optional: bool = False
    """An effect that may be absent."""


def list_questions(actuator: str) -> tuple[PlantQuestion, ...]:
    """Return the questions of an actuator in their order."""
    fields = {
        name: field
        for name, field in PlantSettings.model_fields.items()
        if (field.annotation is float or float in get_args(field.annotation))
        and name in _NO_DEFAULT.get(actuator, set()) | _OPTIONAL.get(actuator, set())
    }
    fields |= {
        name: field
        for name, field in MuscleParameters.model_fields.items()
        if name not in _NOT_OF[actuator]
    }
    ordered = sorted(fields, key=lambda name: name not in _FIRST)
    asked = [_make_question(actuator, name, fields[name]) for name in ordered]
    return (*asked, *_ask_effects(actuator))


def _make_question(actuator: str, name: str, field: FieldInfo) -> PlantQuestion:
    needed = name in _NO_DEFAULT.get(actuator, set())
    return PlantQuestion(
        name,
        field.description or name,
        list_units(name),
        None if needed else _DEFAULTS.get(name, field.default),
        is_optional=name in _OPTIONAL.get(actuator, set()),
    )


def _ask_effects(actuator: str) -> list[PlantQuestion]:
    return [
        PlantQuestion(
            f"{effect}.{parameter.name}",
            f"{effect.replace('_', ' ')}: {parameter.meaning}",
            list_units(parameter.name),
            None,
            is_optional=True,
        )
        for effect in _EFFECTS.get(actuator, ())
        if effect in CATALOGUE
        for parameter in CATALOGUE[effect].parameters
        if not parameter.choices
    ]


# --- the file ------------------------------------------------------------------------------------


def build_plant(actuator: str, values: Mapping[str, float]) -> PlantSettings:
    """Return the plant of these numbers in SI; raise ConfigError where they do not fit together."""
    plant: PlantSettings = validate_settings(
        TypeAdapter(PlantSettings), RawSettings(_nest(actuator, values), {(): "the plant"}), "plant"
    )
    return plant


def format_new_plant(
    actuator: str,
    values: Mapping[str, float],
    texts: Mapping[str, str],
    fitted: str,
    guessed: Collection[str] = (),
) -> str:
    """Write the file, with the meaning of each number behind it.

    `texts` say where numbers are from, `fitted` which of them a diagnosis fits, `guessed` which
    it looks for in a wide range.
    """
    lines = [
        "# Written by `pamctl plant new`, to edit. All numbers are in SI.",
        f"# `pamctl diagnose` fits {fitted}; it takes the other numbers as they are.",
    ]
    questions = list_questions(actuator)
    meanings = {
        q.name: q.meaning + (f"; {texts[q.name]}" if q.name in texts else "") for q in questions
    }
    effect = ""
    for line in dump_yaml(_nest(actuator, values)).splitlines():
        name, _, value = (part.strip() for part in line.partition(":"))
        meaning = meanings.get(name) or meanings.get(f"{effect}.{name}")
        lines.append(f"{line:<42}  # {meaning}" if meaning else line)
        effect = effect if value else name
    if guessed:
        lines.append(f"guessed: [{', '.join(guessed)}]")
    absent = [q for q in questions if q.is_optional and q.name not in values]
    lines += [f"# {q.name} is absent; --value {q.name}='...' adds it: {q.meaning}" for q in absent]
    return "\n".join([*lines, ""])


def _nest(actuator: str, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the numbers in the places that they have in a file."""
    data: dict[str, Any] = {"base": "paper", "actuator": actuator}
    effects: dict[str, dict[str, float]] = {}
    parameters: dict[str, float] = {}
    for name, value in values.items():
        effect, dot, number = name.partition(".")
        if dot:
            effects.setdefault(effect, {})[number] = value
        elif name in PlantSettings.model_fields:
            data[name] = value
        else:
            parameters[name] = value
    return {**data, "parameters": parameters, **({"effects": effects} if effects else {})}
