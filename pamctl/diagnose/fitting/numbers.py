"""The numbers of a plant file that a fit may move, by dotted name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from math import inf, sqrt

from pamctl.diagnose.measured.reach import Reach, reach_of_muscle
from pamctl.plant.catalogue import CATALOGUE, WITH_TERMS
from pamctl.plant.effects.description import EffectParameter
from pamctl.plant.flat import NEUTRAL, PAPER
from pamctl.plant.model import AXIS, PlantSettings, settings_of, values_of
from pamctl.plant.muscle_parameters import (
    HIGHEST_ATMOSPHERE_PA,
    HIGHEST_TANK_PA,
    HOTTEST_K,
    LONGEST_M,
    MuscleParameters,
)
from pamctl.plant.terms.locations import TERMS


@dataclass(frozen=True)
class FreeNumber:
    """One number that a fit may move: `stiffness_n_per_m`, or `valve_spool.time_constant_s`."""

    name: str
    low: float
    high: float
    scale: float
    """A step of this size is small but visible."""
    is_nuisance: bool = False
    """Always free, within the uncertainty of homing, and never named."""
    is_calibrated: bool = False
    """A number of the start model's effects: recalibrated, not named."""
    usual: float | None = None
    """An effect's usual value on this machine, from which a fit may start."""

    @property
    def effect(self) -> str | None:
        """The effect on trial that the number belongs to; None for numbers that are always free."""
        on_trial = "." in self.name and not (self.is_nuisance or self.is_calibrated)
        return self.name.split(".")[0] if on_trial else None


_RANGES: Mapping[str, tuple[float, float]] = {
    "valve_gain_m2_per_v": (0.2, 5.0),
    "tank_pressure_pa": (0.8, 1.25),
    "damping_n_s_per_m": (0.1, 10.0),
    "stiffness_n_per_m": (0.2, 5.0),
    "kinetic_friction_per_m": (0.0, 5.0),
    "braid_length_m": (0.99, 1.01),
    "mass_kg": (0.1, 10.0),
    "rest_length_m": (0.95, 1.05),
    "braid_turns": (0.8, 1.25),
    "braid_count": (0.5, 2.0),
    "braid_contact_area_m2": (0.2, 5.0),
    "atmospheric_pressure_pa": (0.6, 1.08),
    "temperature_k": (0.85, 1.2),
    "gas_constant_j_per_kg_k": (0.5, 2.0),
    "heat_capacity_ratio": (0.8, 1.25),
}
"""Every number of a plant file, with its limits as factors of the file's value.

Lengths are measured with a tape, to 1 %; places of work lie between 60 and 110 kPa. What a user
guesses (gain, damping, stiffness, mass) may be three times off, and is then inside.
"""
_STEPS = {"braid_length_m": 2e-4, "rest_length_m": 2e-4}
"""Share of a number that is a small but visible step; for all others a hundredth."""
_TERM_FACTOR = 5.0
"""A term of the plant file may have another size, of either sign, up to this multiple."""
_AXIS_FACTOR = 30.0
"""Limits of mass, damping, stiffness and area of a direct mechanism: the value times or over it."""

CALIBRATED: Mapping[str, tuple[str, ...]] = {
    "pressure": ("valve_gain_m2_per_v", "tank_pressure_pa", "braid_length_m"),
    "mechanics": (
        "damping_n_s_per_m",
        "stiffness_n_per_m",
        "kinetic_friction_per_m",
        "braid_length_m",
    ),
}
"""The numbers that are recalibrated in each block of a muscle; geometry is in both.

Rest length and turns are left out: they cannot be distinguished from the braid's length and the
stiffness.
"""

SENSOR_ZERO = "pressure_sensor_offset.offset_pa"
ZERO_PA = 250.0
"""A quarter of the smallest offset of interest."""
AREA = "piston.area_m2"
LOAD = "external_load.force_n"
"""The constant load of a direct mechanism; the zero of its force sensor is the same to all data."""


def calibration_of(block: str, nominal: PlantSettings) -> tuple[str, ...]:
    """Return the numbers that are recalibrated in a block, without those that are known.

    A direct mechanism has no braid. Its spring is recalibrated if it has one.
    """
    names = CALIBRATED[block]
    if nominal.actuator == "chamber":
        names = ("valve_gain_m2_per_v", "tank_pressure_pa")
    if nominal.actuator == "direct":
        spring = ("stiffness_n_per_m",) if nominal.parameters.stiffness_n_per_m > 0.0 else ()
        names = ("mass_kg", "damping_n_s_per_m", *spring, LOAD)
    return tuple(name for name in names if name not in nominal.known)


def list_plant_numbers(nominal: PlantSettings) -> tuple[str, ...]:
    """Return every number of the plant file that acts on this actuator, known ones included."""
    if nominal.actuator == "direct":
        return (*AXIS, "atmospheric_pressure_pa")
    if nominal.actuator == "chamber":
        return AIR
    return tuple(MuscleParameters.model_fields)


AIR = (
    "tank_pressure_pa",
    "atmospheric_pressure_pa",
    "gas_constant_j_per_kg_k",
    "temperature_k",
    "heat_capacity_ratio",
    "valve_gain_m2_per_v",
)
"""The parameters of a chamber; its volume is measured."""

UNITS: Mapping[str, str] = {
    "mass_kg": "kg",
    "damping_n_s_per_m": "N s/m",
    "stiffness_n_per_m": "N/m",
    "rest_length_m": "m",
    "braid_length_m": "m",
    "braid_turns": "",
    "kinetic_friction_per_m": "1/m",
    "braid_count": "",
    "braid_contact_area_m2": "m^2",
    "tank_pressure_pa": "Pa",
    "atmospheric_pressure_pa": "Pa",
    "gas_constant_j_per_kg_k": "J/(kg K)",
    "temperature_k": "K",
    "heat_capacity_ratio": "",
    "valve_gain_m2_per_v": "m^2/V",
}


def calibrated_number(name: str, nominal: PlantSettings, reach: Reach | None = None) -> FreeNumber:
    """Return one of the plant file's numbers with its range around the file's value.

    Any number that `list_plant_numbers` gives may be asked. `reach` is that of the records; a
    direct mechanism needs it for numbers that the file has as 0.
    """
    value = value_of(nominal, name)
    if name == LOAD:
        low, high, scale, _ = _range_on(look_up_parameter(name), nominal, reach)
        low, high = min(low, 2.0 * value), max(high, 2.0 * value)
        return FreeNumber(name, low, high, scale, is_calibrated=True)
    if value == 0.0:  # no spring, no friction: it may be there, from nothing on
        size = PAPER[name] if reach is None else reach.size_of(UNITS[name])
        return FreeNumber(name, 0.0, 3.0 * size, 1e-2 * size)
    low, high = _RANGES[name]
    if nominal.actuator == "direct" and name in AXIS:
        low, high = 1.0 / _AXIS_FACTOR, _AXIS_FACTOR
    low, high = _limit_by_others(name, low * value, high * value, nominal)
    return FreeNumber(name, low, high, _STEPS.get(name, 1e-2) * value)


def _limit_by_others(
    name: str, low: float, high: float, nominal: PlantSettings
) -> tuple[float, float]:
    """Keep a number where the plant file's other numbers allow it (`MuscleParameters`)."""
    p, inside = nominal.parameters, 1e-6
    limits = {
        "braid_length_m": (p.rest_length_m, min(sqrt(3.0) * p.rest_length_m, LONGEST_M)),
        "rest_length_m": (p.braid_length_m / sqrt(3.0), p.braid_length_m),
        "tank_pressure_pa": (p.atmospheric_pressure_pa, HIGHEST_TANK_PA),
        "atmospheric_pressure_pa": (0.0, min(p.tank_pressure_pa, HIGHEST_ATMOSPHERE_PA)),
        "temperature_k": (0.0, HOTTEST_K),
        "heat_capacity_ratio": (1.0, 2.0),
    }
    least, most = limits.get(name, (0.0, inf))
    return max(low, least * (1.0 + inside)), min(high, most * (1.0 - inside))


def sensor_zero(nominal: PlantSettings) -> FreeNumber:
    """Return the pressure sensor's zero: homing leaves 100 Pa, which moves the muscle by 11 um."""
    value = value_of(nominal, SENSOR_ZERO)
    return FreeNumber(SENSOR_ZERO, value - ZERO_PA, value + ZERO_PA, 50.0, is_nuisance=True)


# Of an effect on a direct mechanism, over the usual size of its unit in the records: the smallest
# size of interest, the start of a fit, the most. The catalogue's sizes are a muscle's.
_SHARES: Mapping[str, tuple[float, float, float]] = {
    "N": (0.01, 0.05, 1.0),
    "N/m": (0.02, 0.05, 3.0),
    "N/m3": (0.02, 0.1, 100.0),
    "N s/m": (0.05, 0.1, 10.0),
    "m": (1e-4, 1e-3, 0.2),
    "m/s": (0.01, 0.05, 1.0),
    "m/N": (2e-3, 0.02, 1.0),
    "N/Pa": (0.01, 0.05, 2.0),
    "N s/(m Pa)": (0.01, 0.05, 5.0),
    "m2": (0.01, 0.05, 1.0),
}
SAME_SIZE = 1.5
"""A muscle whose forces and lengths differ by less than this factor has the catalogue's ranges."""


def _range_on(
    parameter: EffectParameter, nominal: PlantSettings, reach: Reach | None
) -> tuple[float, float, float, float]:
    """Return least, most, smallest of interest and usual value of an effect's number.

    They follow the machine: what the records of a direct mechanism reach, or what a muscle of
    this size can do.
    """
    low, high, smallest = parameter.low, parameter.high, parameter.smallest_of_interest
    usual = parameter.start
    if not parameter.is_scaled and not _is_of_chamber(nominal, parameter.unit):
        return low, high, smallest, usual
    if nominal.actuator != "direct":
        ratio = _size_beside_paper(nominal, parameter.unit)
        ratio = 1.0 if 1.0 / SAME_SIZE < ratio < SAME_SIZE else ratio
        if not parameter.is_scaled:  # the catalogue limits a plant file
            ratio = min(ratio, 1.0)
        return low * ratio, high * ratio, smallest * ratio, usual * ratio
    if reach is None or parameter.unit not in _SHARES:
        return low, high, smallest, usual
    size = reach.size_of(parameter.unit)
    smallest, usual, high = (share * size for share in _SHARES[parameter.unit])
    if parameter.unit == "m":
        smallest = max(smallest, reach.least_way_m)
        usual, high = max(usual, 4.0 * smallest), max(high, 40.0 * smallest)
    if parameter.unit in ("N", "N/Pa", "m2"):
        high *= max(reach.load_n / reach.force_n, 1.0)
    if parameter.role == "shape":  # as wide as the catalogue says, at least
        low, high = min(low, 0.1 * smallest), max(parameter.high, high)
        return low, high, smallest, usual
    return (-high if low < 0.0 else 0.0), high, smallest, usual


_PAPER = reach_of_muscle(PlantSettings())
_PAPER_GAIN_M2_PER_V = PAPER["valve_gain_m2_per_v"]


def _is_of_chamber(nominal: PlantSettings, unit: str) -> bool:
    """Tell whether a number is a resistance to the flow of a chamber, which follows its valve."""
    return nominal.actuator == "chamber" and unit in _OF_FLOW


_OF_FLOW: Mapping[str, int] = {"Pa s/kg": 1, "Pa s2/kg2": 2}
"""Units of resistances, and the power of the valve's area that they fall with."""


def _size_beside_paper(nominal: PlantSettings, unit: str) -> float:
    """Return the usual size of a quantity on this muscle or chamber over that on the paper's.

    A chamber has no forces: areas are compared with the valve, volumes with its own.
    """
    if nominal.actuator == "muscle":
        return reach_of_muscle(nominal).size_of(unit) / _PAPER.size_of(unit)
    valve = nominal.parameters.valve_gain_m2_per_v / _PAPER_GAIN_M2_PER_V
    if unit == "m2":
        return valve
    if unit in _OF_FLOW:
        return valve ** -_OF_FLOW[unit]
    return (nominal.chamber_volume_m3 or 0.0) / _PAPER.size_of("m3") if unit == "m3" else 1.0


def numbers_of_effect(
    effect: str, names: Collection[str], nominal: PlantSettings, reach: Reach | None = None
) -> tuple[FreeNumber, ...]:
    """Return numbers of an effect with their ranges on this machine."""
    ranges = {
        p.name: _range_on(p, nominal, reach)
        for p in CATALOGUE[effect].parameters
        if p.name in names
    }
    return tuple(
        FreeNumber(f"{effect}.{name}", low, high, smallest, usual=usual)
        for name, (low, high, smallest, usual) in ranges.items()
    )


def active_effects(nominal: PlantSettings) -> tuple[str, ...]:
    """Return the effects of the start model, without zeros that are recalibrated anyway."""
    zero_pa = value_of(nominal, SENSOR_ZERO)
    homed = {SENSOR_ZERO.split(".")[0]} if abs(zero_pa) <= ZERO_PA else set()
    if nominal.actuator == "direct" and LOAD not in nominal.known:
        homed.add(LOAD.split(".")[0])
    return tuple(n for n in nominal.acting if n not in homed)


def numbers_of_start(
    nominal: PlantSettings, blocks: Collection[str], reach: Reach | None = None
) -> tuple[FreeNumber, ...]:
    """Return the numbers of the start model's effects that these blocks show, and that may move.

    Only numbers off neutral and within their ranges are freed, so the form of the effect does not
    change. The sensor's zero and a direct mechanism's load are always free; known numbers never
    are, nor is the piston's area where nothing else tells how large the forces are.
    """
    fixed = {SENSOR_ZERO, *nominal.known, *hold_scale_of_forces(nominal, reach)}
    return tuple(
        free
        for name in active_effects(nominal)
        if not WITH_TERMS[name].unidentifiable and {*WITH_TERMS[name].seen_by} & {*blocks}
        for p in WITH_TERMS[name].parameters
        if not p.choices
        and f"{name}.{p.name}" not in fixed
        and (p.name == "size" or name not in TERMS)  # the shape of a term is that of its plant file
        for free in (_number_of_start(name, p, nominal, reach),)
        if free.low < value_of(nominal, free.name) < free.high
        and (p.role == "shape" or value_of(nominal, free.name) != p.neutral)
    )


def hold_scale_of_forces(nominal: PlantSettings, reach: Reach | None) -> tuple[str, ...]:
    """Return the piston's area where pressure alone drives a mechanism, and no force is known.

    Then mass, damping, springs, frictions and the area may all be multiplied by one factor, and
    the motion stays the same: the file's area is the measure of all.
    """
    if reach is None or reach.has_force or not value_of(nominal, AREA):
        return ()
    known = {name for name in nominal.known if value_of(nominal, name) and _has_force(name)}
    return () if known else (AREA,)


def _has_force(name: str) -> bool:
    """Tell whether a number grows in proportion to the forces, or to what they are over."""
    unit = look_up_parameter(name).unit if "." in name else UNITS[name]
    return unit in (*(u for u in _SHARES if u not in ("m", "m/s")), "kg")


def _number_of_start(
    effect: str, parameter: EffectParameter, nominal: PlantSettings, reach: Reach | None
) -> FreeNumber:
    """Return a number of the start model; a guess may be off by decades on a direct mechanism."""
    name = f"{effect}.{parameter.name}"
    low, high, scale, _ = _range_on(parameter, nominal, reach)
    value = value_of(nominal, name)
    if effect in TERMS:
        most = _TERM_FACTOR * abs(value)
        return FreeNumber(name, -most, most, 0.01 * abs(value), is_calibrated=True)
    if nominal.actuator == "direct" and parameter.is_scaled and value != 0.0:
        most = _AXIS_FACTOR * abs(value)
        # Where a number may have either sign, the guess may have the wrong one.
        low, high = -most if parameter.low < 0.0 else value / _AXIS_FACTOR, most
        scale = 0.01 * abs(value)
    return FreeNumber(name, low, high, scale, is_calibrated=True)


def look_up_parameter(dotted: str) -> EffectParameter:
    """Return the catalogue's entry of an effect's number, such as `valve_leak.area_m2`."""
    effect, name = dotted.split(".")
    return next(p for p in WITH_TERMS[effect].parameters if p.name == name)


def unit_of(free: FreeNumber) -> str:
    """Return the unit for reports; empty for a plain number."""
    unit = look_up_parameter(free.name).unit if "." in free.name else UNITS[free.name]
    return "" if unit == "1" else unit


def value_of(settings: PlantSettings, name: str) -> float:
    """Return a number of a plant; an inactive effect has its neutral values."""
    values = values_of(settings)
    return values[name] if name in values else NEUTRAL[name]


def with_values(settings: PlantSettings, values: Mapping[str, float]) -> PlantSettings:
    """Return the plant with these numbers; raise pydantic's ValidationError if out of range."""
    moved = settings_of({**values_of(settings), **values})
    return moved.model_copy(update={"known": settings.known})
