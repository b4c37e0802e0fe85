"""A plant file from a datasheet: the numbers to give, in which units, and the file's text.

Numbers are read as datasheets have them: `200 mm`, `6 bar gauge`, `25 mm bore`, `350 l/min`. A
number without a unit is in SI. The suffix of a setting's name says what it measures. The list of
numbers follows the settings: one that is added there is in it, with its own description.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import TypeAdapter

from pamctl.base.errors import ExitCode
from pamctl.log.importing.headers import find_units
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import AXIS, PlantSettings
from pamctl.plant.paper import ROOM_K, MuscleParameters
from pamctl.settings.resolve import RawSettings, validate_settings
from pamctl.settings.yaml12 import dump_yaml

_NUMBER = re.compile(r"\s*([-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
_THOUSAND = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
"""What is read in two ways: a comma between thousands, or before a fraction."""
STEEPEST_BRAID_DEG = 54.7
"""A braid at a larger angle to the axis does not contract when filled."""
NOMINAL_UPSTREAM_PA, NOMINAL_DOWNSTREAM_PA = 7e5, 6e5
"""Where datasheets state a valve's nominal flow: from 6 to 5 bar gauge."""
NORMAL_AIR_KG_PER_M3 = 1.185
"""Air of ISO 6358's reference: 20 degC, 100 kPa, 65 % humidity."""
NORMAL_K = 293.15
FULL_COMMAND_V = 5.0

Known = Mapping[str, float]
"""The settings that were read before."""
Reading = Callable[[float, Known], float]


class DatasheetError(Exception):
    """A number cannot be read, or cannot be right. The message says what would do."""

    exit_code = ExitCode.USAGE


def list_units(name: str) -> str:
    """Name the units in which a setting may be given, with the other ways to give it."""
    others = _OTHER_WAYS.get(name.split(".")[-1], "")
    known = ", ".join(find_units(name))
    return f"{known}{', ' if known and others else ''}{others}" or "a plain number"


_OTHER_WAYS = {
    "tank_pressure_pa": "each with `gauge` (above the atmosphere) or `absolute`",
    "braid_length_m": f"or the braid's angle to the axis at rest, up to {STEEPEST_BRAID_DEG:g} deg",
    "braid_turns": "a number, or `13 mm diameter`, the braid's diameter at rest",
    "area_m2": "or `25 mm bore`",
    "cylinder_area_m2": "or `25 mm bore`",
    "valve_gain_m2_per_v": "or `350 l/min`, the nominal flow at full opening",
    "temperature_k": "or `20 C`",
}


def read_quantity(name: str, text: str, known: Known) -> float:
    """Return a setting in SI from a text. Raise DatasheetError."""
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
    read = _list_readings(name).get(_squeeze(match[2]))
    value = math.nan if read is None else read(number, known)
    if not math.isfinite(value):
        raise DatasheetError(f"{name}: {match[0].strip()!r} is unclear; give {list_units(name)}")
    return value


def _squeeze(unit: str) -> str:
    """Return a unit as it is compared: datasheets write it in many ways."""
    bare = re.sub(r"[\s*^().\N{MIDDLE DOT}\N{DEGREE SIGN}]", "", unit)
    return bare.replace("\N{SUPERSCRIPT TWO}", "2").replace("L", "l")


def _list_readings(name: str) -> dict[str, Reading]:
    """Return, by squeezed unit, what makes SI of a number; NaN where it cannot be."""

    def scale(factor: float) -> Reading:
        return lambda number, known: number * factor

    plain, units = name.split(".")[-1], find_units(name)
    found = {"": scale(1.0)} | {_squeeze(unit): scale(f) for unit, f in units.items()}
    lengths = find_units("length_m").items()
    if plain == "tank_pressure_pa":  # a bare unit does not say which
        found = {"": scale(1.0)}
        for unit, factor in units.items():
            found |= {f"{unit}{sense}": scale(factor) for sense in ("absolute", "abs")}
            found |= {f"{unit}{sense}": _above_air(factor) for sense in ("gauge", "g")}
    elif plain == "temperature_k":
        found |= {unit: lambda number, known: number + 273.15 for unit in ("C", "degC")}
    elif plain == "braid_length_m":
        found |= dict.fromkeys(("deg", "degree", "degrees"), _find_braid_length)
    elif plain == "braid_turns":
        found |= {f"{unit}diameter": _find_turns(factor) for unit, factor in lengths}
    elif plain in ("area_m2", "cylinder_area_m2"):
        for unit, factor in lengths:
            found |= {f"{unit}{what}": _find_area(factor) for what in ("bore", "diameter")}
    elif plain == "valve_gain_m2_per_v":
        found |= dict.fromkeys(("l/min", "Nl/min", "nl/min", "lpm", "l/minANR"), _find_valve_gain)
    return found


def _above_air(factor: float) -> Reading:
    return lambda number, known: number * factor + known["atmospheric_pressure_pa"]


def _find_braid_length(angle_deg: float, known: Known) -> float:
    """Return b of L_0 = b cos(theta)."""
    if not 0.0 < angle_deg < STEEPEST_BRAID_DEG:
        return math.nan
    return known["rest_length_m"] / math.cos(math.radians(angle_deg))


def _find_turns(factor: float) -> Reading:
    """Return n of n pi D = b sin(theta)."""

    def read(diameter: float, known: Known) -> float:
        length_m, braid_m = known["rest_length_m"], known["braid_length_m"]
        if diameter <= 0.0 or braid_m <= length_m:
            return math.nan
        return math.sqrt(braid_m**2 - length_m**2) / (math.pi * diameter * factor)

    return read


def _find_area(factor: float) -> Reading:
    """Return the area of a bore; the sign says where pressure pushes."""
    return lambda bore, known: math.copysign(0.25 * math.pi * (bore * factor) ** 2, bore)


def _find_valve_gain(flow_l_per_min: float, known: Known) -> float:
    """Return K_Av of a nominal flow, by the model's own orifice (Eq. 8)."""
    from pamctl.plant.paper import orifice_flow
    from pamctl.plant.parameters import parameters_of

    del known
    air = parameters_of({"temperature_k": NORMAL_K}).paper
    flow = orifice_flow(air, NOMINAL_UPSTREAM_PA, NOMINAL_DOWNSTREAM_PA)
    return flow_l_per_min * 1e-3 / 60.0 * NORMAL_AIR_KG_PER_M3 / (FULL_COMMAND_V * flow)


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
_FRICTION = ("coulomb_friction", "return_friction", "braid_drag")
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


def list_questions(actuator: str, given: Collection[str] = ()) -> tuple[PlantQuestion, ...]:
    """Return the questions of an actuator in their order, and those of effects that are `given`."""
    needed, optional = _NO_DEFAULT.get(actuator, set()), _OPTIONAL.get(actuator, set())
    own = PlantSettings.model_fields
    fields = {
        name: own[name]
        for name in own
        if name in needed | optional
        and (own[name].annotation is float or float in get_args(own[name].annotation))
    }
    of_muscle = MuscleParameters.model_fields
    fields |= {name: of_muscle[name] for name in of_muscle if name not in _NOT_OF[actuator]}
    asked = [
        PlantQuestion(
            name,
            fields[name].description or name,
            list_units(name),
            None if name in needed else _DEFAULTS.get(name, fields[name].default),
            is_optional=name in optional,
        )
        for name in sorted(fields, key=lambda name: name not in _FIRST)
    ]
    usual = _EFFECTS.get(actuator, ())
    asked += [
        PlantQuestion(
            f"{effect}.{parameter.name}",
            f"{effect.replace('_', ' ')}: {parameter.meaning}",
            list_units(parameter.name),
            None,
            is_optional=True,
        )
        for effect in dict.fromkeys((*usual, *CATALOGUE))
        if effect in CATALOGUE
        for parameter in CATALOGUE[effect].parameters
        if not parameter.choices and (effect in usual or f"{effect}.{parameter.name}" in given)
    ]
    return tuple(asked)


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
    questions = list_questions(actuator, values)
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
