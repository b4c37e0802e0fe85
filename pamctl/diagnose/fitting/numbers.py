"""The numbers of a plant file that a fit may move, by dotted name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.description import EffectParameter
from pamctl.plant.flat import NEUTRAL
from pamctl.plant.model import PlantSettings, settings_of, values_of


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

    @property
    def effect(self) -> str | None:
        """The effect on trial that the number belongs to; None for numbers that are always free."""
        on_trial = "." in self.name and not (self.is_nuisance or self.is_calibrated)
        return self.name.split(".")[0] if on_trial else None


_CALIBRATION = {
    "valve_gain_m2_per_v": (0.5, 2.0),
    "tank_pressure_pa": (0.8, 1.25),
    "damping_n_s_per_m": (0.3, 3.0),
    "stiffness_n_per_m": (0.6, 1.6),
    "kinetic_friction_per_m": (0.0, 3.0),
    "braid_length_m": (0.99, 1.01),
}
"""Numbers that are recalibrated before the search for effects, with their limits as factors of the
plant file's values.

The braid's length is measured with a tape, to 1 %. Rest length and turns are left out: they cannot
be distinguished from the braid's length and the stiffness.
"""

CALIBRATED: Mapping[str, tuple[str, ...]] = {
    "pressure": ("valve_gain_m2_per_v", "tank_pressure_pa", "braid_length_m"),
    "mechanics": (
        "damping_n_s_per_m",
        "stiffness_n_per_m",
        "kinetic_friction_per_m",
        "braid_length_m",
    ),
}
"""The numbers that are recalibrated in each block; geometry is in both."""

SENSOR_ZERO = "pressure_sensor_offset.offset_pa"
ZERO_PA = 250.0
"""A quarter of the smallest offset of interest."""


def calibration_of(block: str, nominal: PlantSettings) -> tuple[str, ...]:
    """Return the numbers that are recalibrated in a block.

    A mechanism without a muscle has no braid. Its dry friction is recalibrated instead, if the
    model has one.
    """
    if nominal.actuator == "muscle":
        return CALIBRATED[block]
    if nominal.actuator == "chamber":
        return ("valve_gain_m2_per_v", "tank_pressure_pa")
    dry = (DRY_FRICTION,) if nominal.effects.model_dump().get("coulomb_friction") else ()
    return ("damping_n_s_per_m", "stiffness_n_per_m", *dry)


DRY_FRICTION = "coulomb_friction.force_n"

UNITS: Mapping[str, str] = {
    "valve_gain_m2_per_v": "m^2/V",
    "tank_pressure_pa": "Pa",
    "damping_n_s_per_m": "N s/m",
    "stiffness_n_per_m": "N/m",
    "kinetic_friction_per_m": "1/m",
    "braid_length_m": "m",
}


def calibrated_number(name: str, nominal: PlantSettings) -> FreeNumber:
    """Return one of the muscle's numbers with its range around the plant file's value."""
    value = value_of(nominal, name)
    if name == DRY_FRICTION:
        return FreeNumber(name, 0.0, 3.0 * value, 0.01 * value, is_nuisance=True)
    low, high = _CALIBRATION[name]
    scale = 2e-4 if name == "braid_length_m" else 1e-2
    return FreeNumber(name, low * value, high * value, scale * value)


def sensor_zero(nominal: PlantSettings) -> FreeNumber:
    """Return the pressure sensor's zero: homing leaves 100 Pa, which moves the muscle by 11 um."""
    value = value_of(nominal, SENSOR_ZERO)
    return FreeNumber(SENSOR_ZERO, value - ZERO_PA, value + ZERO_PA, 50.0, is_nuisance=True)


def numbers_of_effect(effect: str, names: Collection[str]) -> tuple[FreeNumber, ...]:
    """Return numbers of an effect with the ranges of the catalogue."""
    return tuple(
        FreeNumber(f"{effect}.{p.name}", p.low, p.high, p.smallest_of_interest)
        for p in CATALOGUE[effect].parameters
        if p.name in names
    )


def active_effects(nominal: PlantSettings) -> tuple[str, ...]:
    """Return the effects of the start model, without a sensor offset within homing's error."""
    zero_pa = value_of(nominal, SENSOR_ZERO)
    homed = {SENSOR_ZERO.split(".")[0]} if abs(zero_pa) <= ZERO_PA else set()
    return tuple(n for n in nominal.effects.model_dump(exclude_none=True) if n not in homed)


def numbers_of_start(nominal: PlantSettings, blocks: Collection[str]) -> tuple[FreeNumber, ...]:
    """Return the numbers of the start model's effects that these blocks show.

    Only numbers off neutral and within their ranges are freed, so the form of the effect does not
    change. The sensor's zero and a direct actuator's dry friction are always free.
    """
    free_anyway = {SENSOR_ZERO, *((DRY_FRICTION,) if nominal.actuator == "direct" else ())}
    return tuple(
        FreeNumber(f"{name}.{p.name}", p.low, p.high, p.smallest_of_interest, is_calibrated=True)
        for name in active_effects(nominal)
        if not CATALOGUE[name].unidentifiable and {*CATALOGUE[name].seen_by} & {*blocks}
        for p in CATALOGUE[name].parameters
        if not p.choices
        and f"{name}.{p.name}" not in free_anyway
        and p.low < value_of(nominal, f"{name}.{p.name}") < p.high
        and (p.role == "shape" or value_of(nominal, f"{name}.{p.name}") != p.neutral)
    )


def look_up_parameter(free: FreeNumber) -> EffectParameter:
    """Return the catalogue's entry of an effect's number; raise KeyError for a muscle's number."""
    effect, name = free.name.split(".")
    return next(p for p in CATALOGUE[effect].parameters if p.name == name)


def unit_of(free: FreeNumber) -> str:
    """Return the unit for reports; empty for a plain number."""
    unit = look_up_parameter(free).unit if "." in free.name else UNITS[free.name]
    return "" if unit == "1" else unit


def value_of(settings: PlantSettings, name: str) -> float:
    """Return a number of a plant; an inactive effect has its neutral values."""
    values = values_of(settings)
    return values[name] if name in values else NEUTRAL[name]


def with_values(settings: PlantSettings, values: Mapping[str, float]) -> PlantSettings:
    """Return the plant with these numbers; raise pydantic's ValidationError if out of range."""
    moved = settings_of({**values_of(settings), **values})
    return moved.model_copy(update={"correction": settings.correction})
