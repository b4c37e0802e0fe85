"""Read numbers as datasheets have them: `200 mm`, `6 bar gauge`, `25 mm bore`, `350 l/min`.

A number without a unit is in SI. The suffix of a setting's name says what it measures.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from pamctl.exit_codes import ExitCode
from pamctl.units import find_units

_LENGTHS = find_units("length_m")
_NUMBER = re.compile(r"\s*([-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
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
