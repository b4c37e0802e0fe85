"""Terms: what may be wrong at a place of the plant, said without a name of the catalogue.

    term = location x operator x driver      a force  x  a memory of 1.5 mm  x  the position

A location is a place of the plant, an operator says how the driver acts, a driver is a signal of
the plant. One location holds one term. `pamctl diagnose` finds them where no effect of the
catalogue fits; a plant file states them under `terms:`. The equations of a plant without terms are
those of the paper, to the bit.

The operators: how a driver acts, as a shape that a term's size multiplies.

    constant      1                          dead_zone    -clip(q, -w, w) / Q
    gain          q / Q                      saturation   (clip(q, -w, w) - q) / Q
    curve         five hats from low to high lag          (z - q) / Q,  w z' = q - z
    beyond        max(q - w, 0) / Q          play         (z - q) / Q,  |z - q| <= w / 2
    wave          sin(2 pi q / w + phase)    slew         (z - q) / Q,  |z'| <= w
    onset         0 before w, 1 after        hysteresis   z,  dz = (sign(dq) - z) |dq| / w

q is the driver, w the term's inner number in the driver's unit (a time for `lag`, a rate for
`slew`), Q the driver's reference: 1 V, 10 mm, 100 kPa, 0.1 m/s, 1 s. The hysteresis is Bouc and
Wen's state: it depends on the last reversal, and not on the rate. All are kernels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, pi, sin
from typing import TYPE_CHECKING, NamedTuple

from pamctl.kernel.calls import machine
from pamctl.plant.effects.description import (
    ACTUATORS,
    Actuator,
    Block,
    EffectDescription,
    EffectParameter,
    shape,
)
from pamctl.plant.effects.places import Part, follow_with_play, lag_weights

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

OPERATORS = (
    "constant", "gain", "curve", "beyond", "wave", "onset",
    "dead_zone", "saturation", "lag", "play", "slew", "hysteresis",
)  # fmt: skip
CONSTANT, GAIN, CURVE, BEYOND, WAVE, ONSET = range(6)
DEAD_ZONE, SATURATION, LAG, PLAY, SLEW, HYSTERESIS = range(6, 12)
WITH_MEMORY = ("lag", "play", "slew", "hysteresis")
NEEDS_INNER = ("wave", "dead_zone", "saturation", "lag", "play", "slew", "hysteresis")
"""Operators whose inner number is a width, a period or a time."""

COMMAND_AT, FILLING_AT, EXHAUSTING_AT, SUPPLY_AT, FLOW_AT, VOLUME_AT = range(6)
FORCE_AT, STIFFNESS_AT, DAMPING_AT, BRAID_AT, DRY_AT, PULL_AT, PRESSING_AT = range(6, 13)
PRESSURE_SENSOR_AT, ENCODER_AT, OPENING_AT, LEAK_AT = range(13, 17)
"""Places of the locations in `LOCATIONS`."""

DRIVERS = ("command", "position", "pressure", "velocity", "time")
COMMAND, POSITION, PRESSURE, VELOCITY, TIME = range(5)
REFERENCES = {"command": 1.0, "position": 0.01, "pressure": 1e5, "velocity": 0.1, "time": 1.0}
"""What a size is for, in the driver's unit: so many newtons for each 10 mm."""
DRIVER_UNITS = {"command": "V", "position": "m", "pressure": "Pa", "velocity": "m/s", "time": "s"}

ONSET_SHARE = 0.02
"""Share of the instant over which an onset rises: a fit needs a slope."""
KNOTS = 5


def numbers_of_operator(operator: str) -> tuple[str, ...]:
    """Return the names of the numbers that an operator has beside its size."""
    if operator in ("constant", "gain"):
        return ()
    if operator == "curve":
        return ("low", "high", *(f"knot_{k}" for k in range(1, KNOTS + 1)))
    return ("inner", "phase") if operator == "wave" else ("inner",)


class PlantTerm(NamedTuple):
    """The numbers of a term; without a size it does not act."""

    size: float = 0.0
    location: float = -1.0
    """Place in `LOCATIONS`."""
    operator: float = 0.0
    """Place in `OPERATORS`."""
    driver: float = 0.0
    """Place in `DRIVERS`."""
    inner: float = 1.0
    phase: float = 0.0
    """Of a wave, rad."""
    low: float = 0.0
    """Where a curve begins."""
    high: float = 1.0
    knot_1: float = 0.0
    knot_2: float = 0.0
    knot_3: float = 0.0
    knot_4: float = 0.0
    knot_5: float = 0.0


class TermMemory(NamedTuple):
    """What a lag, a play, a slew limit or a hysteresis remembers."""

    kept: float = 0.0
    is_on: float = 0.0
    """0 until the first step, which sets what is kept to the driver's first value."""


class Terms(NamedTuple):
    """The terms of a plant: one for each part of a step. None of a plant: it has no terms."""

    valve: PlantTerm = PlantTerm()
    air: PlantTerm = PlantTerm()
    mechanics: PlantTerm = PlantTerm()
    sensors: PlantTerm = PlantTerm()


def reference_of(term: PlantTerm) -> float:
    """Return the driver's reference, Q; equal to `REFERENCES`."""
    if term.driver == POSITION:
        return 0.01
    if term.driver == PRESSURE:
        return 1e5
    if term.driver == VELOCITY:
        return 0.1
    return 1.0


def shape_of(term: PlantTerm, value: float, memory: TermMemory) -> float:
    """Return the shape at a driver's value; a term's effect is its size times this."""
    operator = term.operator
    if operator == CONSTANT:
        return 1.0
    if operator == GAIN:
        return value / reference_of(term)
    if operator == CURVE:
        return bend_curve(term, value)
    if operator == BEYOND:
        return max(value - term.inner, 0.0) / reference_of(term)
    if operator == WAVE:
        return sin(2.0 * pi * value / term.inner + term.phase)
    if operator == ONSET:
        rise = ONSET_SHARE * term.inner
        return min(max((value - term.inner) / rise, 0.0), 1.0) if rise > 0.0 else 1.0
    clipped = min(max(value, -term.inner), term.inner)
    if operator == DEAD_ZONE:
        return -clipped / reference_of(term)
    if operator == SATURATION:
        return (clipped - value) / reference_of(term)
    if memory.is_on == 0.0:
        return 0.0
    if operator == HYSTERESIS:
        return memory.kept
    return (memory.kept - value) / reference_of(term)


def bend_curve(term: PlantTerm, value: float) -> float:
    """Return the curve through the five knots: linear between them, constant beyond."""
    along = (KNOTS - 1) * (value - term.low) / (term.high - term.low)
    if along <= 1.0:
        return term.knot_1 + max(along, 0.0) * (term.knot_2 - term.knot_1)
    if along <= 2.0:
        return term.knot_2 + (along - 1.0) * (term.knot_3 - term.knot_2)
    if along <= 3.0:
        return term.knot_3 + (along - 2.0) * (term.knot_4 - term.knot_3)
    return term.knot_4 + min(along - 3.0, 1.0) * (term.knot_5 - term.knot_4)


def follow_value(
    term: PlantTerm, memory: TermMemory, begin: float, end: float, step_s: float
) -> TermMemory:
    """Return the memory after a step in which the driver goes linearly from `begin` to `end`."""
    operator = term.operator
    kept = memory.kept
    if memory.is_on == 0.0 and operator != HYSTERESIS:
        kept = begin
    if operator == LAG:
        share, weight = lag_weights(term.inner, step_s)
        kept = share * kept + (1.0 - share) * begin + weight * (end - begin)
    elif operator == PLAY:
        kept = follow_with_play(kept, end, term.inner)
    elif operator == SLEW:
        way = term.inner * step_s
        kept += min(max(end - kept, -way), way)
    elif operator == HYSTERESIS and end != begin and term.inner > 0.0:
        limit = 1.0 if end > begin else -1.0
        kept = limit + (kept - limit) * exp(-abs(end - begin) / term.inner)
    return TermMemory(kept, 1.0)


# --- where terms act in a step ------------------------------------------------------------------


class TermDrivers(NamedTuple):
    """What may drive a term: a part of a step fills in the signals that it has."""

    command_v: float = 0.0
    position_m: float = 0.0
    gauge_pa: float = 0.0
    velocity_m_per_s: float = 0.0
    age_s: float = 0.0


NO_MEMORY = TermMemory()


def push_of(term: PlantTerm, location: int, memory: TermMemory, now: TermDrivers) -> float:
    """Return the size times the shape at the driver's value; 0 if the term is at another place."""
    if term.size == 0.0 or term.location != location:
        return 0.0
    value = now.command_v
    if term.driver == POSITION:
        value = now.position_m
    elif term.driver == PRESSURE:
        value = now.gauge_pa
    elif term.driver == VELOCITY:
        value = now.velocity_m_per_s
    elif term.driver == TIME:
        value = now.age_s
    return term.size * shape_of(term, value, memory)


def share_of(term: PlantTerm, location: int, memory: TermMemory, now: TermDrivers) -> float:
    """Return the factor by which the term changes a value by a share; never below 0."""
    return max(1.0 + push_of(term, location, memory, now), 0.0)


def pass_command_term(
    terms: Terms | None, memory: TermMemory | None, command_v: float, now_s: float, step_s: float
) -> tuple[float, TermMemory | None]:
    """Return the command (V) with what the term adds after a constant command, and its memory."""
    if terms is None or memory is None:
        return command_v, memory
    memory = follow_value(terms.valve, memory, command_v, command_v, step_s)
    now = TermDrivers(command_v=command_v, age_s=now_s)
    return command_v + push_of(terms.valve, COMMAND_AT, memory, now), memory


def pass_opening_term(terms: Terms | None, opening_v: float, age_s: float) -> float:
    """Return the opening, changed by a share on one side or on both."""
    if terms is None or opening_v == 0.0:
        return opening_v
    now = TermDrivers(command_v=abs(opening_v), age_s=age_s)
    side = share_of(terms.valve, FILLING_AT if opening_v > 0.0 else EXHAUSTING_AT, NO_MEMORY, now)
    return opening_v * side * share_of(terms.valve, OPENING_AT, NO_MEMORY, now)


def follow_motion_term(
    terms: Terms | None,
    memory: TermMemory | None,
    begin_m: float,
    end_m: float,
    gauge_pa: float,
    step_s: float,
) -> TermMemory | None:
    """Return the memory of the mechanics' term after a step; the pressure is the middle's."""
    if terms is None or memory is None:
        return memory
    term = terms.mechanics
    if term.driver == PRESSURE:
        return follow_value(term, memory, gauge_pa, gauge_pa, step_s)
    return follow_value(term, memory, begin_m, end_m, step_s)


def show_pressure_term(
    terms: Terms | None, shown_pa: float, atmosphere_pa: float, age_s: float
) -> float:
    """Return the pressure that the sensor shows, with what the term adds."""
    if terms is None:
        return shown_pa
    now = TermDrivers(gauge_pa=shown_pa - atmosphere_pa, age_s=age_s)
    return shown_pa + push_of(terms.sensors, PRESSURE_SENSOR_AT, NO_MEMORY, now)


def show_position_term(terms: Terms | None, shown_m: float, age_s: float) -> float:
    """Return the displacement that the encoder shows, with what the term adds."""
    if terms is None:
        return shown_m
    now = TermDrivers(position_m=shown_m, age_s=age_s)
    return shown_m + push_of(terms.sensors, ENCODER_AT, NO_MEMORY, now)


ROUNDS = 3
"""A term changes a reading by little: what is behind it is found in so many rounds."""


def undo_reading_term(
    place: str, terms: Terms | None, shown: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the readings of sensors without the term; `place` is that of the effects."""
    if terms is None or terms.sensors.size == 0.0:
        return shown
    true = shown.copy()
    machine(fill_undone)(place == "pressure_reading", terms, shown, times_s, atmosphere_pa, true)
    return true


def fill_undone(
    is_pressure: bool, terms: Terms, shown: Array, times_s: Array, atmosphere_pa: float, true: Array
) -> None:
    """Kernel of `undo_reading_term`: find what the term turns into each reading."""
    for k in range(len(shown)):
        for _ in range(ROUNDS):
            if is_pressure:
                again = show_pressure_term(terms, true[k], atmosphere_pa, times_s[k])
            else:
                again = show_position_term(terms, true[k], times_s[k])
            true[k] -= again - shown[k]


# --- their names, units and ranges --------------------------------------------------------------

SUFFIX = "_term"
"""A term's numbers are called after its location: `force_term.size`."""
ANY = 1e15


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
    actuators: tuple[Actuator, ...] = ACTUATORS

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
_BEHIND_VALVE: tuple[Actuator, ...] = ("muscle", "chamber", "cylinder")
_MOVING: tuple[Actuator, ...] = ("muscle", "direct", "cylinder")

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
                 ("position", "pressure"), (), _AIR, ("muscle", "cylinder")),
        Location("force", "a force", "N", 0.5, "mechanics", _MOTION, ("position", "pressure"),
                 actuators=_MOVING),
        Location("stiffness", "the stiffness", "N/m", 100.0, "mechanics", ("pressure", "time"),
                 actuators=_MOVING),
        Location("damping", "the damping", "N s/m", 10.0, "mechanics", _MOTION,
                 actuators=_MOVING),
        Location("braid_friction", "the braid's friction", "1", 0.05, "mechanics", _MOTION,
                 actuators=("muscle",)),
        Location("dry_friction", "the dry friction", "1", 0.05, "mechanics", _MOTION,
                 actuators=("direct", "cylinder")),
        Location("pull", "the muscle's pull", "1", 0.01, "mechanics", _MOTION, ("position",),
                 actuators=("muscle", "cylinder")),
        Location("pressing", "the pressure that pulls", "Pa", 500.0, "mechanics", _MOTION,
                 actuators=("muscle",)),
        Location("pressure_sensor", "the pressure sensor's reading", "Pa", 500.0, "sensors",
                 ("pressure", "time"), (), ("pressure", "mechanics"), _BEHIND_VALVE),
        Location("encoder", "the encoder's reading", "m", 2e-5, "sensors",
                 ("position", "time"), actuators=_MOVING),
        Location("opening", "the valve's opening", "1", 0.02, "valve", ("command", "time"), (),
                 _AIR, _BEHIND_VALVE),
        Location("leak", "a leak into the room", "m2", 1e-8, "air",
                 ("command", "pressure", "position", "time"), (), _AIR, _BEHIND_VALVE),
    )
}  # fmt: skip
"""By name, in the order of the numbers `..._AT`."""

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
