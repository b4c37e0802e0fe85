"""Terms on forces, friction and damping; a plant without terms passes None."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.places import FrictionBand
from pamctl.plant.terms.operators import (
    BRAID_AT,
    DAMPING_AT,
    DRY_AT,
    FORCE_AT,
    PRESSING_AT,
    PRESSURE,
    PULL_AT,
    STIFFNESS_AT,
    TIME,
    VELOCITY,
    PlantTerm,
    TermMemory,
    Terms,
    follow_value,
    shape_of,
)


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
