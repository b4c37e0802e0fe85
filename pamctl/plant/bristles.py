"""Motion on the bristles of friction, for the effect `presliding`: exact for each of its forms."""

from __future__ import annotations

from math import exp, expm1, inf, isinf, sqrt
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pamctl.plant.effects.friction import Presliding

ELASTO_PLASTIC, DAHL, LUGRE, MAXWELL_SLIP = 0.0, 1.0, 2.0, 3.0
ELEMENTS = 4
"""Springs on sliders of the form Maxwell slip."""


class Bristles(NamedTuple):
    """Forces of the bristles, or of what limits them; most forms have the first only."""

    first_n: float = inf
    """Infinite until they are first loaded."""
    second_n: float = 0.0
    third_n: float = 0.0
    fourth_n: float = 0.0


class SlipEnd(NamedTuple):
    """The end of a step on bristles."""

    way_m: float
    velocity_m_per_s: float
    gained: Bristles
    """What the bristles have gained in the direction of motion."""


def add_up_n(bristles: Bristles) -> float:
    """Return the force of all bristles together."""
    return bristles.first_n + bristles.second_n + bristles.third_n + bristles.fourth_n


def share_out(presliding: Presliding, force_n: float) -> Bristles:
    """Return each bristle's share of a force that they hold together."""
    if presliding.form != MAXWELL_SLIP:
        return Bristles(force_n, 0.0, 0.0, 0.0)
    second, third = presliding.second_over_first, presliding.third_over_first
    fourth = presliding.fourth_over_first
    first_n = force_n / (1.0 + second + third + fourth)
    return Bristles(first_n, second * first_n, third * first_n, fourth * first_n)


def clamp_bristles(
    presliding: Presliding, bristles: Bristles, drive_n: float, lower_n: float, upper_n: float
) -> Bristles:
    """Return the bristles' forces within the band [lower, upper]; unloaded ones take the drive."""
    held = share_out(presliding, drive_n) if isinf(bristles.first_n) else bristles
    low, high = share_out(presliding, lower_n), share_out(presliding, upper_n)
    return Bristles(
        min(max(held.first_n, low.first_n), high.first_n),
        min(max(held.second_n, low.second_n), high.second_n),
        min(max(held.third_n, low.third_n), high.third_n),
        min(max(held.fourth_n, low.fourth_n), high.fourth_n),
    )


def add(one: Bristles, other: Bristles, times: float = 1.0) -> Bristles:
    """Return the sum of two sets of forces, the second `times` over, bristle by bristle."""
    return Bristles(
        one.first_n + times * other.first_n,
        one.second_n + times * other.second_n,
        one.third_n + times * other.third_n,
        one.fourth_n + times * other.fourth_n,
    )


def bristle_damping(presliding: Presliding, left_n: float, width_n: float) -> float:
    """Return sigma_1 dz/dx, the damping that LuGre's bristle adds at `left_n` below its limit."""
    if presliding.form != LUGRE:
        return 0.0
    return presliding.bristle_damping_n_s_per_m * left_n / width_n


def slip(
    presliding: Presliding,
    mass_kg: float,
    damping_n_s_per_m: float,
    velocity_m_per_s: float,
    surplus_n: float,
    left: Bristles,
    width_n: float,
    step_s: float,
) -> SlipEnd:
    """Slip for one step; all values are positive in the direction of motion.

    `surplus_n` is the drive minus the bristles' present force; `left` is how much each force can
    still grow. Mean force and distance depend on each other. The distance a v + b (drive - mean
    force) is exact for mass and damping under a constant force. The mean force of a bristle over a
    distance has a closed form, and grows with the distance: there is one solution for any
    stiffness. The distance is at least 0.
    """
    rate = damping_n_s_per_m / mass_kg
    by_speed_s, by_push_s2 = travel_weights(rate, step_s)
    by_force = by_push_s2 / mass_kg
    free_m = by_speed_s * velocity_m_per_s + by_force * surplus_n
    if free_m <= 0.0:
        return SlipEnd(0.0, 0.0, Bristles(0.0, 0.0, 0.0, 0.0))
    stiffness = 1.0 / presliding.compliance_m_per_n
    if presliding.form == MAXWELL_SLIP:
        way_m, mean_n = _maxwell_slip(free_m, by_force, stiffness / ELEMENTS, left)
        bent_n = stiffness / ELEMENTS * way_m
        gained = Bristles(
            min(left.first_n, bent_n),
            min(left.second_n, bent_n),
            min(left.third_n, bent_n),
            min(left.fourth_n, bent_n),
        )
    elif presliding.form == ELASTO_PLASTIC:
        way_m, gained_n, mean_n = _elasto_plastic(free_m, by_force, stiffness, left.first_n)
        gained = Bristles(gained_n, 0.0, 0.0, 0.0)
    else:
        way_m, gained_n, mean_n = _dahl(free_m, by_force, stiffness / width_n, left.first_n)
        gained = Bristles(gained_n, 0.0, 0.0, 0.0)
    end_m_per_s = velocity_m_per_s * exp(-rate * step_s)
    return SlipEnd(way_m, end_m_per_s + (surplus_n - mean_n) / mass_kg * by_speed_s, gained)


def advance_bristles(
    presliding: Presliding, bristles: Bristles, lower_n: float, upper_n: float, way_m: float
) -> Bristles:
    """Return the bristles' forces after a given way within the band [lower, upper].

    Unloaded bristles (infinite) start in the middle of the band.
    """
    held = clamp_bristles(presliding, bristles, 0.5 * (lower_n + upper_n), lower_n, upper_n)
    bent = way_m / presliding.compliance_m_per_n
    if presliding.form == ELASTO_PLASTIC:
        pushed = add(held, Bristles(bent, 0.0, 0.0, 0.0))
        return clamp_bristles(presliding, pushed, 0.0, lower_n, upper_n)
    if presliding.form == MAXWELL_SLIP:
        each = bent / ELEMENTS
        pushed = add(held, Bristles(each, each, each, each))
        return clamp_bristles(presliding, pushed, 0.0, lower_n, upper_n)
    limit_n = upper_n if way_m > 0.0 else lower_n
    left_n = (held.first_n - limit_n) * exp(-abs(bent) / (upper_n - lower_n))
    return Bristles(limit_n + left_n, 0.0, 0.0, 0.0)


def _elasto_plastic(
    free_m: float, by_force: float, stiffness: float, left_n: float
) -> tuple[float, float, float]:
    """Return distance, gain and mean gain of a spring on a slider."""
    way_m = free_m / (1.0 + 0.5 * by_force * stiffness)
    if stiffness * way_m <= left_n:
        return way_m, stiffness * way_m, 0.5 * stiffness * way_m
    # It begins to slide within the distance: the mean is left - left^2 / (2 stiffness way).
    past_m = free_m - by_force * left_n
    lag_m2 = 0.5 * by_force * left_n * left_n / stiffness
    root_m = sqrt(past_m * past_m + 4.0 * lag_m2)
    way_m = 0.5 * (past_m + root_m) if past_m >= 0.0 else 2.0 * lag_m2 / (root_m - past_m)
    return way_m, left_n, (free_m - way_m) / by_force


def _dahl(
    free_m: float, by_force: float, per_m: float, left_n: float
) -> tuple[float, float, float]:
    """Return distance, gain and mean gain of a softening bristle: left (1 - e^(-q)), q = way per_m.

    Newton's method from 0: the residual is increasing and concave, so no step overshoots.
    """
    way_m, mean_n, gained_n = 0.0, 0.0, 0.0
    for _ in range(50):
        q = per_m * way_m
        if q < 1e-4:
            mean_n = left_n * q * (0.5 - q / 6.0)
            slope = left_n * per_m * (0.5 - q / 3.0)
            gained_n = left_n * q * (1.0 - 0.5 * q)
        else:
            bent = exp(-q)
            gained_n = left_n * (1.0 - bent)
            mean_n = left_n * (1.0 - (1.0 - bent) / q)
            slope = left_n * per_m * ((1.0 - bent) / (q * q) - bent / q)
        change_m = (free_m - by_force * mean_n - way_m) / (1.0 + by_force * slope)
        way_m += change_m
        if abs(change_m) <= 1e-12 * free_m + 1e-18:
            break
    return way_m, gained_n, mean_n


def _maxwell_slip(
    free_m: float, by_force: float, stiffness: float, left: Bristles
) -> tuple[float, float]:
    """Return distance and mean gain of four springs on sliders, of this stiffness each.

    Newton's method, from the distance where none slides: the residual is increasing and concave.
    """
    way_m, mean_n = free_m / (1.0 + 0.5 * by_force * ELEMENTS * stiffness), 0.0
    for _ in range(50):
        mean_n = (
            _mean_gain_n(stiffness, left.first_n, way_m)
            + _mean_gain_n(stiffness, left.second_n, way_m)
            + _mean_gain_n(stiffness, left.third_n, way_m)
            + _mean_gain_n(stiffness, left.fourth_n, way_m)
        )
        slope = (
            _slope_of_gain(stiffness, left.first_n, way_m)
            + _slope_of_gain(stiffness, left.second_n, way_m)
            + _slope_of_gain(stiffness, left.third_n, way_m)
            + _slope_of_gain(stiffness, left.fourth_n, way_m)
        )
        change_m = (free_m - by_force * mean_n - way_m) / (1.0 + by_force * slope)
        way_m += change_m
        if abs(change_m) <= 1e-12 * free_m + 1e-18:
            break
    return way_m, mean_n


def _mean_gain_n(stiffness: float, left_n: float, way_m: float) -> float:
    """Return the mean force that a spring on a slider gains over a distance."""
    bent_n = stiffness * way_m
    return 0.5 * bent_n if bent_n <= left_n else left_n - 0.5 * left_n * left_n / bent_n


def _slope_of_gain(stiffness: float, left_n: float, way_m: float) -> float:
    """Return by how much that mean grows with the distance."""
    bent_n = stiffness * way_m
    if bent_n <= left_n:
        return 0.5 * stiffness
    return 0.5 * stiffness * (left_n / bent_n) * (left_n / bent_n)


def travel_weights(rate_per_s: float, step_s: float) -> tuple[float, float]:
    """Return the distance per speed at the start (s) and per constant acceleration (s^2).

    Of v' = a - rate v, after `step_s`; the first is also the speed per acceleration.
    """
    decayed = rate_per_s * step_s
    if decayed < 1e-4:  # the series: the closed form loses its digits
        by_speed = 1.0 - decayed * (0.5 - decayed / 6.0)
        by_force = 0.5 - decayed * (1.0 / 6.0 - decayed / 24.0)
    else:
        by_speed = -expm1(-decayed) / decayed
        by_force = (1.0 - by_speed) / decayed
    return by_speed * step_s, by_force * step_s * step_s
