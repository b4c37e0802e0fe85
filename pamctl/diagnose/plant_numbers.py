"""The numbers of a plant by dotted name: values, units, meanings; and a number that was fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, log10

from pamctl.plant.catalogue import WITH_TERMS
from pamctl.plant.effects.description import EffectParameter
from pamctl.plant.model import PlantSettings, settings_of, values_of
from pamctl.plant.parameters import NEUTRAL

UNITS: Mapping[str, str] = {
    "mass_kg": "kg",
    "damping_n_s_per_m": "N s/m",
    "stiffness_n_per_m": "N/m",
    "rest_length_m": "m",
    "braid_length_m": "m",
    "braid_turns": "",
    "kinetic_friction_per_m": "1/m",
    "braid_count": "",
    "braid_contact_area_m2": "m2",
    "tank_pressure_pa": "Pa",
    "atmospheric_pressure_pa": "Pa",
    "gas_constant_j_per_kg_k": "J/(kg K)",
    "temperature_k": "K",
    "heat_capacity_ratio": "",
    "valve_gain_m2_per_v": "m2/V",
    "chamber_volume_m3": "m3",
    "cylinder_area_m2": "m2",
    "cylinder_volume_m3": "m3",
    "stroke_m": "m",
}
"""Units of the numbers that are no effect's."""


@dataclass(frozen=True)
class FittedNumber:
    """A fitted number with its 90 % interval."""

    name: str
    value: float
    low: float
    high: float
    unit: str

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        return {"value": self.value, "ci90": [self.low, self.high], "unit": self.unit}

    def spell(self) -> list[str]:
        """Return value, interval and unit; of the half width of the interval two digits count."""
        half, size, digits = 0.5 * (self.high - self.low), abs(self.value), 4
        if half > 0.0 and size > 0.0:
            digits = min(max(ceil(log10(size / half)) + 1, 3), 9)
        numbers = (self.value, self.low, self.high)
        value, *ends = (f"{x:#.{digits}g}".rstrip(".") for x in numbers)
        return [value, " to ".join(ends), self.unit]


def look_up_parameter(dotted: str) -> EffectParameter:
    """Return the catalogue's entry of an effect's number, such as `valve_leak.area_m2`."""
    effect, name = dotted.split(".")
    return next(p for p in WITH_TERMS[effect].parameters if p.name == name)


def unit_of(name: str) -> str:
    """Return the unit of a number for reports; empty for a plain number."""
    unit = look_up_parameter(name).unit if "." in name else UNITS[name]
    return "" if unit == "1" else unit


def value_of(settings: PlantSettings, name: str) -> float:
    """Return a number of a plant; an inactive effect has its neutral values."""
    values = values_of(settings)
    return values[name] if name in values else NEUTRAL[name]


def with_values(settings: PlantSettings, values: Mapping[str, float]) -> PlantSettings:
    """Return the plant with these numbers; raise pydantic's ValidationError if out of range."""
    moved = settings_of({**values_of(settings), **values})
    return moved.model_copy(update={"known": settings.known, "noise": settings.noise})
