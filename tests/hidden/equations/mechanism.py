"""What moves: spring, damping, and friction that at rest may take any value within its band.

A trapezoidal step in the velocity, with the three cases (slips forward, slips back, sticks)
solved one after the other: a time-stepping method of non-smooth mechanics, where the plant has
the exact flow between events.
"""

from __future__ import annotations

import math

from hidden.equations.air import braid_grip, braid_lever, pull_area


def band(p, x, gauge_pa, speed, t_s):
    """Return the least and greatest dry friction (N): Eq. 5 gives [0, F_c] and no more."""
    grip = 0.0
    if p.direct == 0.0:
        grip = braid_grip(p, x, gauge_pa, t_s) * braid_lever(p, x)
    rise = 1.0
    if p.stribeck > 0.0:
        rise += p.stribeck * math.exp(-((abs(speed) / p.stribeck_m_per_s) ** p.stribeck_exponent))
    if p.grip_wave != 0.0:
        rise *= 1.0 + p.grip_wave * math.sin(2.0 * math.pi * x / p.grip_wave_m)
    dry = p.coulomb_n
    if p.dry_per_pa > 0.0:
        dry += p.dry_per_pa * max(gauge_pa, 0.0)
    low, high = -rise * (p.return_share * grip + dry), rise * (grip + dry)
    return low * (1.0 - p.dry_tilt), high * (1.0 + p.dry_tilt)


def elastic(p, state, x, t_s):
    """Return everything that pulls back with position: Eq. 4's k x, and what may be added."""
    force = p.stiffness * x + p.cubic * (x * x * x)
    if p.stiffness_trend_per_s != 0.0:
        force += p.stiffness_trend_per_s * t_s * p.stiffness * x
    if p.creep_n_per_m > 0.0:
        fast = p.creep_fast_share
        force += p.creep_n_per_m * (
            (1.0 - fast) * (x - state.creep_slow_m) + fast * (x - state.creep_fast_m)
        )
    if p.stop_m > 0.0 and x > p.stop_m:
        force += p.stop_n_per_m * (x - p.stop_m)
    if p.kink_m > 0.0 and x > p.kink_m:
        force += p.kink_n_per_m * (x - p.kink_m)
    if p.cog_n != 0.0:
        force += cogging(p, x)
    return force + state.loop_n


def cogging(p, x):
    """Return the magnets' (or teeth's) force: periodic, but for what the rail does to it."""
    rail = math.sin(2.0 * math.pi * x / p.rail_m)
    return p.cog_n * (1.0 + 0.4 * rail) * math.sin(2.0 * math.pi * x / p.cog_m + 0.8 * rail)


def pull(p, x, gauge_pa, force_n):
    """Return the driving force: the muscle's (Eq. 3), or the one that is given."""
    if p.direct == 1.0:
        return force_n - p.load_n
    effective = gauge_pa
    if p.threshold_pa > 0.0:
        effective = max(gauge_pa - p.threshold_pa, 0.0)
    muscle = effective * pull_area(p, x, gauge_pa) * (1.0 + p.pull_per_m * x)
    return muscle + p.piston_m2 * gauge_pa - p.load_n


def drag(p, x, gauge_pa, forward, t_s):
    """Return the viscous coefficient of one direction: Eq. 5's grip only where x grows."""
    viscous = p.damping + p.pressure_damping * max(gauge_pa, 0.0) + p.drag_per_m * x
    viscous *= 1.0 + p.viscous_tilt if forward else 1.0 - p.viscous_tilt
    if forward and p.direct == 0.0:
        viscous += (1.0 + p.braid_drag) * braid_grip(p, x, gauge_pa, t_s)
    return viscous


def velocity_after(p, v, net, forward_drag, backward_drag, low, high, h):
    """Return the velocity after h, friction being set-valued at rest."""
    inertia = p.mass_kg / h
    before = 0.5 * v * (forward_drag if v > 0.0 else backward_drag)
    forward = (inertia * v + net - before - high) / (inertia + 0.5 * forward_drag)
    if forward > 0.0:
        return forward
    backward = (inertia * v + net - before - low) / (inertia + 0.5 * backward_drag)
    return min(backward, 0.0)


def strained(force, stiffness, low, high, way):
    """Return a bristle's force after `way`: it bends, and slides off as the band is reached.

    LuGre's equation, solved exactly over a stretch of constant direction.
    """
    force = min(max(force, low), high)
    width = high - low
    if width < 1e-9:
        return force
    limit = high if way > 0.0 else low
    return limit + (force - limit) * math.exp(-stiffness * abs(way) / width)


def dragged(force, stiffness, low, high, way):
    """Return an elasto-plastic element's force after `way`: a spring on a slider."""
    return min(max(force + stiffness * way, low), high)


SLIP_A, SLIP_B, SLIP_C, SLIP_D = 0.1, 0.2, 0.3, 0.4
"""Share of the band that each Maxwell-slip element can hold; the narrow ones slip first."""


def loop_after(p, force, way):
    """Return a hysteretic spring's own force: Bouc and Wen's, of constant height."""
    if p.loop_n == 0.0:
        return 0.0
    limit = math.copysign(p.loop_n, way)
    return limit + (force - limit) * math.exp(-abs(way) / p.loop_m)
