"""Where terms act in a step; a plant without terms passes None."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.kernel.calls import machine
from pamctl.plant.effects.places import FrictionBand
from pamctl.plant.terms import (
    BRAID_AT,
    COMMAND,
    COMMAND_AT,
    DAMPING_AT,
    DRY_AT,
    ENCODER_AT,
    EXHAUSTING_AT,
    FILLING_AT,
    FLOW_AT,
    FORCE_AT,
    OPENING_AT,
    POSITION,
    PRESSING_AT,
    PRESSURE,
    PRESSURE_SENSOR_AT,
    PULL_AT,
    STIFFNESS_AT,
    SUPPLY_AT,
    TIME,
    VELOCITY,
    VOLUME_AT,
    PlantTerm,
    TermMemory,
    Terms,
    follow_value,
    shape_of,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def pass_command_term(
    terms: Terms | None, memory: TermMemory | None, command_v: float, age_s: float
) -> float:
    """Return the command with what the term adds, V."""
    if terms is None or memory is None:
        return command_v
    term = terms.valve
    if term.size == 0.0 or term.location != COMMAND_AT:
        return command_v
    value = age_s if term.driver == TIME else command_v
    return command_v + term.size * shape_of(term, value, memory)


def follow_command_term(
    terms: Terms | None, memory: TermMemory | None, command_v: float, step_s: float
) -> TermMemory | None:
    """Return the memory after a step of constant command."""
    if terms is None or memory is None:
        return memory
    return follow_value(terms.valve, memory, command_v, command_v, step_s)


def pass_opening_term(terms: Terms | None, opening_v: float, age_s: float) -> float:
    """Return the opening, changed by a share on one side or on both."""
    if terms is None:
        return opening_v
    term = terms.valve
    if term.size == 0.0:
        return opening_v
    fills = opening_v > 0.0 and term.location == FILLING_AT
    exhausts = opening_v < 0.0 and term.location == EXHAUSTING_AT
    if fills or exhausts or term.location == OPENING_AT:
        value = age_s if term.driver == TIME else abs(opening_v)
        return opening_v * max(1.0 + term.size * shape_of(term, value, TermMemory(0.0, 0.0)), 0.0)
    return opening_v


LOWEST_SUPPLY_PA = 1e3
LEAST_SHARE = 0.05
"""A term takes no more of the volume than this leaves."""


def pass_supply_term(terms: Terms | None, supply_pa: float, age_s: float) -> float:
    """Return the supply's absolute pressure with what the term adds."""
    if terms is None:
        return supply_pa
    term = terms.air
    if term.size == 0.0 or term.location != SUPPLY_AT:
        return supply_pa
    return max(
        supply_pa + term.size * shape_of(term, age_s, TermMemory(0.0, 0.0)), LOWEST_SUPPLY_PA
    )


def add_flow_term(
    terms: Terms | None,
    flow_kg_per_s: float,
    opening_v: float,
    gauge_pa: float,
    position_m: float,
    age_s: float,
) -> float:
    """Return the added mass flow into the muscle with what the term adds."""
    if terms is None:
        return flow_kg_per_s
    term = terms.air
    if term.size == 0.0 or term.location != FLOW_AT:
        return flow_kg_per_s
    value = gauge_pa
    if term.driver == COMMAND:
        value = opening_v
    elif term.driver == POSITION:
        value = position_m
    elif term.driver == TIME:
        value = age_s
    return flow_kg_per_s + term.size * shape_of(term, value, TermMemory(0.0, 0.0))


def pass_volume_term(
    terms: Terms | None, volume_m3: float, position_m: float, gauge_pa: float
) -> float:
    """Return the volume of the air with what the term adds."""
    if terms is None:
        return volume_m3
    term = terms.air
    if term.size == 0.0 or term.location != VOLUME_AT:
        return volume_m3
    value = position_m if term.driver == POSITION else gauge_pa
    added_m3 = term.size * shape_of(term, value, TermMemory(0.0, 0.0))
    return max(volume_m3 + added_m3, LEAST_SHARE * volume_m3)


class MotionPoint(NamedTuple):
    """What may drive a term of the mechanics."""

    position_m: float
    velocity_m_per_s: float
    gauge_pa: float
    age_s: float


def needs_speed(terms: Terms | None) -> bool:
    """Tell whether the velocity drives a force."""
    if terms is None:
        return False
    return terms.mechanics.size != 0.0 and terms.mechanics.driver == VELOCITY


def scaled_shape(term: PlantTerm, memory: TermMemory, here: MotionPoint) -> float:
    """Return the size times the shape at the driver's value."""
    value = here.position_m
    if term.driver == PRESSURE:
        value = here.gauge_pa
    elif term.driver == VELOCITY:
        value = here.velocity_m_per_s
    elif term.driver == TIME:
        value = here.age_s
    return term.size * shape_of(term, value, memory)


def add_force_term(
    terms: Terms | None, memory: TermMemory | None, force_n: float, here: MotionPoint
) -> float:
    """Return the pull with what a force, or a spring, of the term adds."""
    if terms is None or memory is None:
        return force_n
    term = terms.mechanics
    if term.size == 0.0:
        return force_n
    if term.location == FORCE_AT:
        return force_n + scaled_shape(term, memory, here)
    if term.location == STIFFNESS_AT:
        return force_n - scaled_shape(term, memory, here) * here.position_m
    return force_n


def follow_motion_term(
    terms: Terms | None,
    memory: TermMemory | None,
    begin_m: float,
    end_m: float,
    gauge_pa: float,
    step_s: float,
) -> TermMemory | None:
    """Return the memory after a step; the pressure is that of the step's middle."""
    if terms is None or memory is None:
        return memory
    term = terms.mechanics
    if term.driver == PRESSURE:
        return follow_value(term, memory, gauge_pa, gauge_pa, step_s)
    return follow_value(term, memory, begin_m, end_m, step_s)


def scale_term(
    terms: Terms | None, memory: TermMemory | None, location: int, value: float, here: MotionPoint
) -> float:
    """Return a value that the term changes by a share at this location."""
    if terms is None or memory is None:
        return value
    term = terms.mechanics
    if term.size == 0.0 or term.location != location:
        return value
    return value * max(1.0 + scaled_shape(term, memory, here), 0.0)


def add_term(terms: Terms | None, location: int, value: float, here: MotionPoint) -> float:
    """Return a value to which the term adds at this location."""
    if terms is None:
        return value
    term = terms.mechanics
    if term.size == 0.0 or term.location != location:
        return value
    return value + scaled_shape(term, TermMemory(0.0, 0.0), here)


def pass_pulling_term(
    terms: Terms | None, memory: TermMemory | None, pulling_pa: float, here: MotionPoint
) -> float:
    """Return the gauge pressure that pulls: more of it, or as a changed geometry makes it."""
    pressed_pa = add_term(terms, PRESSING_AT, pulling_pa, here)
    return scale_term(terms, memory, PULL_AT, pressed_pa, here)


def pass_grip_term(
    terms: Terms | None, memory: TermMemory | None, grip: float, here: MotionPoint
) -> float:
    """Return mu_k N A_b P_g of Eq. 5, changed by a share."""
    return scale_term(terms, memory, BRAID_AT, grip, here)


def add_damping_term(terms: Terms | None, damping: float, here: MotionPoint) -> float:
    """Return the damping (N s/m) with what the term adds."""
    return add_term(terms, DAMPING_AT, damping, here)


def pass_band_term(
    terms: Terms | None, memory: TermMemory | None, band: FrictionBand, here: MotionPoint
) -> FrictionBand:
    """Return the band of dry friction, changed by a share."""
    if terms is None:
        return band
    times = scale_term(terms, memory, DRY_AT, 1.0, here)
    return FrictionBand(times * band.lower_n, times * band.upper_n)


def show_pressure_term(
    terms: Terms | None, shown_pa: float, atmosphere_pa: float, age_s: float
) -> float:
    """Return the pressure that the sensor shows, with what the term adds."""
    if terms is None:
        return shown_pa
    term = terms.sensors
    if term.size == 0.0 or term.location != PRESSURE_SENSOR_AT:
        return shown_pa
    value = age_s if term.driver == TIME else shown_pa - atmosphere_pa
    return shown_pa + term.size * shape_of(term, value, TermMemory(0.0, 0.0))


def show_position_term(terms: Terms | None, shown_m: float, age_s: float) -> float:
    """Return the displacement that the encoder shows, with what the term adds."""
    if terms is None:
        return shown_m
    term = terms.sensors
    if term.size == 0.0 or term.location != ENCODER_AT:
        return shown_m
    value = age_s if term.driver == TIME else shown_m
    return shown_m + term.size * shape_of(term, value, TermMemory(0.0, 0.0))


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
