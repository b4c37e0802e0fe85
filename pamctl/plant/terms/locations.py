"""The locations of terms: where each enters the plant, its unit, and the drivers it may have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pamctl.plant.effects.description import (
    Actuator,
    Block,
    EffectDescription,
    EffectParameter,
    shape,
)
from pamctl.plant.effects.places import Part
from pamctl.plant.terms.operators import DRIVERS, KNOTS, OPERATORS, WITH_MEMORY, PlantTerm, Terms

SUFFIX = "_term"
"""A term's numbers are called after its location: `force_term.size`."""
ANY = 1e12


@dataclass(frozen=True)
class Location:
    """One place where a term may act."""

    name: str
    words: str
    """What a sentence calls it."""
    unit: str
    """Of the term's size; "1" where the term is a share."""
    usual: float
    """A size that is small but visible on the paper's rig."""
    part: Part
    drivers: tuple[str, ...]
    memory_of: tuple[str, ...] = ()
    """Drivers that an operator with a memory may have."""
    seen_by: tuple[Block, ...] = ("mechanics",)
    actuators: tuple[Actuator, ...] = ("muscle", "direct", "chamber")

    @property
    def term_name(self) -> str:
        """The name of its numbers, before the dot."""
        return f"{self.name}{SUFFIX}"

    def allows(self, operator: str, driver: str) -> bool:
        """Tell whether a term of this operator and driver may act here."""
        return driver in self.drivers and (operator not in WITH_MEMORY or driver in self.memory_of)

    @property
    def description(self) -> EffectDescription:
        """The record of its numbers, as the catalogue has one of each effect."""
        block: Block = "sensors" if self.part == "sensors" else self.seen_by[0]
        return EffectDescription(
            name=self.term_name,
            kind=PlantTerm,
            block=block,
            equation=f"{self.words}, changed by size x operator(driver)",
            parameters=_describe_parameters(self),
            signature="",
            best_experiment="",
            seen_by=self.seen_by,
            woven=(self.part,),
            actuators=self.actuators,
        )


def _describe_parameters(location: Location) -> tuple[EffectParameter, ...]:
    unit = "a share" if location.unit == "1" else location.unit
    return (
        EffectParameter(
            "size", location.unit, 0.0, -ANY, ANY, location.usual,
            f"{unit}; for each 1 V, 10 mm, 100 kPa, 0.1 m/s or 1 s of the driver, unless the "
            "operator has no unit (constant, curve, wave, onset, hysteresis)",
            location.usual,
        ),
        shape("operator", "1", 0.0, len(OPERATORS) - 1.0, usual=0.0, smallest=1.0,
              meaning="how the driver acts", choices=OPERATORS),
        shape("driver", "1", 0.0, len(DRIVERS) - 1.0, usual=0.0, smallest=1.0,
              meaning="the signal that drives it", choices=DRIVERS),
        shape("inner", "1", -ANY, ANY, usual=1.0, smallest=1e-9,
              meaning="the operator's own number, in SI: a width, a period, a time"),
        shape("phase", "rad", -ANY, ANY, usual=0.0, smallest=0.1, meaning="of a wave"),
        shape("low", "1", -ANY, ANY, usual=0.0, smallest=1e-9,
              meaning="where a curve begins, in the driver's SI unit"),
        shape("high", "1", -ANY, ANY, usual=1.0, smallest=1e-9, meaning="where a curve ends"),
        *(
            shape(f"knot_{k}", "1", -ANY, ANY, usual=0.0, smallest=0.1,
                  meaning="of a curve, as a multiple of the size")
            for k in range(1, KNOTS + 1)
        ),
    )  # fmt: skip


_MOTION = ("position", "pressure", "velocity", "time")
_AIR: tuple[Block, ...] = ("pressure",)
_BEHIND_VALVE: tuple[Actuator, ...] = ("muscle", "chamber")
_MOVING: tuple[Actuator, ...] = ("muscle", "direct")

LOCATIONS: dict[str, Location] = {
    location.name: location
    for location in (
        Location("command", "the command", "V", 0.05, "valve", ("command", "time"),
                 ("command",), _AIR, _BEHIND_VALVE),
        Location("filling", "the opening while filling", "1", 0.02, "valve",
                 ("command", "time"), (), _AIR, _BEHIND_VALVE),
        Location("exhausting", "the opening while exhausting", "1", 0.02, "valve",
                 ("command", "time"), (), _AIR, _BEHIND_VALVE),
        Location("supply", "the supply's pressure", "Pa", 2e3, "air", ("time",), (), _AIR,
                 _BEHIND_VALVE),
        Location("flow", "a flow into the muscle", "kg/s", 1e-6, "air",
                 ("command", "pressure", "position", "time"), (), _AIR, _BEHIND_VALVE),
        Location("volume", "the volume of the air", "m3", 1e-6, "air",
                 ("position", "pressure"), (), _AIR, ("muscle",)),
        Location("force", "a force", "N", 0.5, "mechanics", _MOTION, ("position", "pressure"),
                 actuators=_MOVING),
        Location("stiffness", "the stiffness", "N/m", 100.0, "mechanics", ("pressure", "time"),
                 actuators=_MOVING),
        Location("damping", "the damping", "N s/m", 10.0, "mechanics", _MOTION,
                 actuators=_MOVING),
        Location("braid_friction", "the braid's friction", "1", 0.05, "mechanics", _MOTION,
                 actuators=("muscle",)),
        Location("dry_friction", "the dry friction", "1", 0.05, "mechanics", _MOTION,
                 actuators=("direct",)),
        Location("pull", "the muscle's pull", "1", 0.01, "mechanics", _MOTION, ("position",),
                 actuators=("muscle",)),
        Location("pressing", "the pressure that pulls", "Pa", 500.0, "mechanics", _MOTION,
                 actuators=("muscle",)),
        Location("pressure_sensor", "the pressure sensor's reading", "Pa", 500.0, "sensors",
                 ("pressure", "time"), (), ("pressure", "mechanics"), _BEHIND_VALVE),
        Location("encoder", "the encoder's reading", "m", 2e-5, "sensors",
                 ("position", "time"), actuators=_MOVING),
        Location("opening", "the valve's opening", "1", 0.02, "valve", ("command", "time"), (),
                 _AIR, _BEHIND_VALVE),
    )
}  # fmt: skip
"""By name, in the order of the numbers of `operators.py`."""

TERMS: dict[str, EffectDescription] = {
    location.term_name: location.description for location in LOCATIONS.values()
}
"""The records of the terms' numbers, by the names before the dot."""


def make_terms(values: Mapping[str, float]) -> Terms | None:
    """Return the terms among a plant's numbers by flat name; None where none acts.

    Raises ValueError where two terms act in one part of a step.
    """
    found: dict[str, PlantTerm] = {}
    for place, location in enumerate(LOCATIONS.values()):
        name = location.term_name
        if not values.get(f"{name}.size", 0.0):
            continue
        if location.part in found:
            raise ValueError(f"terms: one term a part of the plant; {location.part} has two")
        numbers = {
            p.name: values.get(f"{name}.{p.name}", p.neutral) for p in TERMS[name].parameters
        }
        found[location.part] = PlantTerm(**numbers, location=float(place))
    return Terms(**found) if found else None
