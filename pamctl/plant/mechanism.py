"""The mechanical block with effects: forms of friction, springs, loads.

It uses the exponential midpoint step of `mechanics_step`, and at neutral values gives its bits.
The same forces move a muscle and a direct mechanism, whose drive is a measured force and, with a
piston, a measured pressure:

    M x'' = F + A (P - P_atm) - k x - load - c x' - friction
"""

from __future__ import annotations

from math import exp, log1p
from typing import TYPE_CHECKING, Any

from pamctl.plant.bristles import (
    Bristles,
    SlipEnd,
    add,
    add_up_n,
    bristle_damping,
    clamp_bristles,
    share_out,
    slip,
    travel_weights,
)
from pamctl.plant.catalogue import (
    add_damping,
    add_force,
    depends_on_speed,
    follow_damping,
    follow_force,
    follow_friction,
    pass_friction,
    pass_pulling_pressure,
)
from pamctl.plant.effects.friction import add_braid_drag, position_factor
from pamctl.plant.effects.mechanics import drift_factor, stretch_ratio
from pamctl.plant.effects.places import FrictionBand
from pamctl.plant.paper import AxialForces, braid_lever_m, force_area_m2, slide
from pamctl.plant.parameters import MechanicsState, PlantParameters, keep_in_stroke
from pamctl.plant.terms import (
    BRAID_AT,
    DAMPING_AT,
    DRY_AT,
    FORCE_AT,
    NO_MEMORY,
    PRESSING_AT,
    PULL_AT,
    STIFFNESS_AT,
    VELOCITY,
    TermDrivers,
    TermMemory,
    Terms,
    follow_motion_term,
    push_of,
    share_of,
)

if TYPE_CHECKING:
    from pamctl.plant.paper import AxialForces


def mechanism_step(
    p: PlantParameters,
    position_m: float,
    velocity_m_per_s: float,
    before: MechanicsState,
    middle_pa: float,
    middle_n: float,
    age_s: float,
    step_s: float,
) -> tuple[float, float, MechanicsState]:
    """Advance (x, v) and the memory of the mechanics by one step.

    `middle_pa` is the absolute pressure (Pa) in the middle of the step, `middle_n` the force (N)
    on a direct mechanism.
    """
    half_s = 0.5 * step_s
    middle_m = position_m + half_s * velocity_m_per_s
    gauge_pa = middle_pa - p.paper.atmospheric_pressure_pa
    memory = follow_motion(
        p.effects.mechanics, before.memory, position_m, middle_m, gauge_pa, half_s
    )
    term = follow_motion_term(p.terms, before.term, position_m, middle_m, gauge_pa, half_s)
    middle_age_s = age_s + half_s
    speed = velocity_m_per_s
    if depends_on_speed(p.effects.mechanics) or needs_speed(p.terms):
        # Friction falls with speed: the speed in the middle is predicted twice.
        for _ in range(2):
            forces = mechanism_forces(
                p, memory, term, middle_m, gauge_pa, middle_n, speed, middle_age_s
            )
            _, speed, _ = move_muscle(
                p, forces, before.bristles, position_m, velocity_m_per_s, half_s
            )
    forces = mechanism_forces(p, memory, term, middle_m, gauge_pa, middle_n, speed, middle_age_s)
    end_m, end_v, bristles = move_muscle(
        p, forces, before.bristles, position_m, velocity_m_per_s, step_s
    )
    kept_m = keep_in_stroke(p, end_m)
    if kept_m != end_m:  # a stop takes all speed
        end_m, end_v = kept_m, 0.0
    memory = follow_motion(p.effects.mechanics, before.memory, position_m, end_m, gauge_pa, step_s)
    term = follow_motion_term(p.terms, before.term, position_m, end_m, gauge_pa, step_s)
    return end_m, end_v, MechanicsState(bristles, memory, term)


def follow_motion(
    e: Any, memory: Any, begin_m: float, end_m: float, gauge_pa: float, step_s: float
) -> Any:
    """Advance the memories of the effects (`MechanicsEffects`) over a motion of constant speed."""
    memory = follow_force(e, memory, begin_m, end_m, gauge_pa, step_s)
    memory = follow_friction(e, memory, begin_m, end_m, gauge_pa, step_s)
    return follow_damping(e, memory, begin_m, end_m, gauge_pa, step_s)


def mechanism_forces(
    p: PlantParameters,
    memory: Any,
    term: TermMemory | None,
    position_m: float,
    gauge_pa: float,
    force_n: float,
    velocity_m_per_s: float,
    age_s: float,
) -> AxialForces:
    """Return Eq. 4 and 5 at (x, P, v) with effects; the band at rest is that of zero speed.

    `force_n` drives a direct mechanism, in place of the muscle's pull.
    """
    e, pull_n, lever_m = p.effects.mechanics, force_n, 0.0
    v = velocity_m_per_s
    here = TermDrivers(0.0, position_m, gauge_pa, v, age_s)
    pressing_pa = gauge_pa if gauge_pa > 0.0 else 0.0
    grip = 0.0
    if not p.direct:
        pulling_pa = pass_pulling_pressure(e, gauge_pa, position_m, v, gauge_pa, age_s)
        grip = p.paper.friction_area_m * pressing_pa * drift_factor(e.drift.friction_per_s, age_s)
        grip *= position_factor(e.position_friction, position_m)
        if p.terms is not None and term is not None:
            pulling_pa += push_of(p.terms.mechanics, PRESSING_AT, NO_MEMORY, here)
            pulling_pa *= share_of(p.terms.mechanics, PULL_AT, term, here)
            grip *= share_of(p.terms.mechanics, BRAID_AT, term, here)
        pull_n = pulling_pa * pull_area_m2(p, position_m, gauge_pa)
        lever_m = braid_lever_m(p.paper, position_m)
    stiffness = p.paper.stiffness_n_per_m * drift_factor(e.drift.stiffness_per_s, age_s)
    drive_n = pull_n - stiffness * position_m
    drive_n = add_force(e, memory, drive_n, position_m, v, gauge_pa, age_s)
    damping = add_damping(e, memory, p.paper.damping_n_s_per_m, position_m, v, gauge_pa, age_s)
    if p.terms is not None and term is not None:
        drive_n += push_of(p.terms.mechanics, FORCE_AT, term, here)
        drive_n -= push_of(p.terms.mechanics, STIFFNESS_AT, term, here) * position_m
        damping += push_of(p.terms.mechanics, DAMPING_AT, NO_MEMORY, here)
    now = friction_band(p, memory, term, grip * lever_m, here)
    at_rest = now
    if depends_on_speed(e) or needs_speed(p.terms):
        resting = TermDrivers(0.0, position_m, gauge_pa, 0.0, age_s)
        at_rest = friction_band(p, memory, term, grip * lever_m, resting)
    return AxialForces(
        drive_n,
        now.lower_n,
        now.upper_n,
        add_braid_drag(e.braid_drag, damping * (1.0 + e.viscous_asymmetry.share), grip),
        damping * (1.0 - e.viscous_asymmetry.share),
        at_rest.lower_n,
        at_rest.upper_n,
    )


def friction_band(
    p: PlantParameters, memory: Any, term: TermMemory | None, kinetic_n: float, now: TermDrivers
) -> FrictionBand:
    """Return the band of dry friction around that of Eq. 5."""
    band: FrictionBand = pass_friction(
        p.effects.mechanics, memory, FrictionBand(0.0, kinetic_n), now.position_m,
        now.velocity_m_per_s, now.gauge_pa, now.age_s,
    )  # fmt: skip
    if p.terms is None or term is None:
        return band
    times = share_of(p.terms.mechanics, DRY_AT, term, now)
    return FrictionBand(times * band.lower_n, times * band.upper_n)


def needs_speed(terms: Terms | None) -> bool:
    """Tell whether the velocity drives a term."""
    if terms is None:
        return False
    return terms.mechanics.size != 0.0 and terms.mechanics.driver == VELOCITY


def pull_area_m2(p: PlantParameters, position_m: float, gauge_pa: float) -> float:
    """Return A(x) of Eq. 3 with stretched threads."""
    braid = p.effects.mechanics.braid_stretch
    if braid.compliance_per_pa == 0.0:
        return force_area_m2(p.paper, position_m)
    length = p.paper.rest_length_m - position_m
    stretched = p.paper.braid_length_m * stretch_ratio(braid, gauge_pa)
    return (3.0 * length * length - stretched * stretched) * p.paper.volume_scale


def move_muscle(
    p: PlantParameters,
    forces: AxialForces,
    bristles: Bristles,
    position_m: float,
    velocity_m_per_s: float,
    step_s: float,
) -> tuple[float, float, Bristles]:
    """Return x, v and the bristles' forces after a step under frozen forces."""
    presliding = p.effects.mechanics.presliding
    width_n = forces.upper_n - forces.lower_n
    if presliding.compliance_m_per_n <= 0.0 or width_n <= 0.0:
        if p.direct:
            end_m, end_v = glide(forces, p.paper.mass_kg, position_m, velocity_m_per_s, step_s)
        else:
            end_m, end_v = slide(forces, p.paper.mass_kg, position_m, velocity_m_per_s, step_s)
        if width_n <= 0.0:
            bristles = share_out(presliding, forces.lower_n)
        return end_m, end_v, bristles
    held = clamp_bristles(presliding, bristles, forces.drive_n, forces.lower_n, forces.upper_n)
    surplus_n = forces.drive_n - add_up_n(held)
    left = add(share_out(presliding, forces.upper_n), held, -1.0)
    damping = forces.damping_up_n_s_per_m
    up = slip_with_damping(p, damping, velocity_m_per_s, surplus_n, left, width_n, step_s)
    if up.way_m > 0.0:
        return position_m + up.way_m, up.velocity_m_per_s, add(held, up.gained)
    left = add(held, share_out(presliding, forces.lower_n), -1.0)
    damping = forces.damping_down_n_s_per_m
    down = slip_with_damping(p, damping, -velocity_m_per_s, -surplus_n, left, width_n, step_s)
    return position_m - down.way_m, -down.velocity_m_per_s, add(held, down.gained, -1.0)


def slip_with_damping(
    p: PlantParameters,
    damping: float,
    velocity_m_per_s: float,
    surplus_n: float,
    left: Bristles,
    width_n: float,
    step_s: float,
) -> SlipEnd:
    """Slip for one step; a bristle's damping is taken at the middle of the distance."""
    presliding, mass_kg, left_n = p.effects.mechanics.presliding, p.paper.mass_kg, left.first_n
    bent = damping + bristle_damping(presliding, left_n, width_n)
    slipped = slip(presliding, mass_kg, bent, velocity_m_per_s, surplus_n, left, width_n, step_s)
    if bent == damping:
        return slipped
    middle_n = left_n - 0.5 * slipped.gained.first_n
    bent = damping + bristle_damping(presliding, middle_n, width_n)
    return slip(presliding, mass_kg, bent, velocity_m_per_s, surplus_n, left, width_n, step_s)


def glide(
    forces: AxialForces, mass_kg: float, position_m: float, velocity_m_per_s: float, step_s: float
) -> tuple[float, float]:
    """Move as `slide` does, for any mass and any damping, also none.

    The muscle's velocity settles within a step, that of a machine's axis within seconds: the
    exponentials of `slide` then cancel out.
    """
    v, left_s = velocity_m_per_s, step_s
    for _ in range(2):  # a motion that stops is followed by one that starts, or by rest
        if v > 0.0 or (v == 0.0 and forces.drive_n > forces.rest_upper_n):
            net_n, damping = forces.drive_n - forces.upper_n, forces.damping_up_n_s_per_m
        elif v < 0.0 or forces.drive_n < forces.rest_lower_n:
            net_n, damping = forces.drive_n - forces.lower_n, forces.damping_down_n_s_per_m
        else:
            return position_m, 0.0
        go_s = left_s
        if v * net_n < 0.0:
            go_s = min(stop_time_s(v, net_n / mass_kg, damping / mass_kg), left_s)
        by_speed_s, by_force_s2 = travel_weights(damping / mass_kg, go_s)
        position_m += v * by_speed_s + net_n / mass_kg * by_force_s2
        if go_s == left_s:
            # What is left of the speed, plus the force's share of it.
            return position_m, v * exp(-damping / mass_kg * go_s) + net_n / mass_kg * by_speed_s
        v, left_s = 0.0, left_s - go_s
    return position_m, 0.0


def stop_time_s(velocity_m_per_s: float, push_m_per_s2: float, rate_per_s: float) -> float:
    """Return when v' = push - rate v comes to rest; the push opposes the velocity."""
    free_s = -velocity_m_per_s / push_m_per_s2
    damped = rate_per_s * free_s
    return free_s if damped == 0.0 else free_s * log1p(damped) / damped
