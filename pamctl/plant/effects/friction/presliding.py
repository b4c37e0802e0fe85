"""Before it slides, friction acts as a spring: bristles bend, and keep their force at reversals.

This replaces the set-valued friction at rest. There are three forms: elasto-plastic (a spring on
a slider), Dahl (the spring softens towards its limit), and LuGre (Dahl, with damping of the
bristle). The Stribeck part of LuGre's model is the effect `stribeck`.
"""

from __future__ import annotations

from math import exp, isinf, sqrt
from typing import NamedTuple

from pamctl.plant.axis.glide import travel_weights
from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectForm, shape, size

ELASTO_PLASTIC, DAHL, LUGRE = 0.0, 1.0, 2.0


class Presliding(NamedTuple):
    """Bristles whose force stays within friction's band [lower, upper]."""

    compliance_m_per_n: float = 0.0
    """1 / sigma_0; 0 is friction that sticks rigidly."""
    form: float = ELASTO_PLASTIC
    bristle_damping_n_s_per_m: float = 0.0
    """Sigma_1 of LuGre's form."""


class SlipEnd(NamedTuple):
    """The end of a step on bristles."""

    way_m: float
    velocity_m_per_s: float
    bristle_n: float


def clamp_bristle_n(force_n: float, drive_n: float, lower_n: float, upper_n: float) -> float:
    """Return a bristle's force within the band; an unloaded one (infinite) takes the drive."""
    return min(max(drive_n if isinf(force_n) else force_n, lower_n), upper_n)


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
    left_n: float,
    width_n: float,
    step_s: float,
) -> SlipEnd:
    """Slip for one step; all values are positive in the direction of motion.

    `surplus_n` is the drive minus the bristle's present force; `left_n` is how much that force can
    still grow. Mean force and distance depend on each other. The distance a v + b (drive - mean
    force) is exact for mass and damping under a constant force. The mean force of a bristle over a
    distance has a closed form, and grows with the distance: there is one solution for any
    stiffness. The distance is at least 0. Also returns the force that the bristle has gained.
    """
    rate = damping_n_s_per_m / mass_kg
    by_speed_s, by_push_s2 = travel_weights(rate, step_s)
    by_force = by_push_s2 / mass_kg
    free_m = by_speed_s * velocity_m_per_s + by_force * surplus_n
    if free_m <= 0.0:
        return SlipEnd(0.0, 0.0, 0.0)
    stiffness = 1.0 / presliding.compliance_m_per_n
    if presliding.form == ELASTO_PLASTIC:
        way_m, gained_n, mean_n = _elasto_plastic(free_m, by_force, stiffness, left_n)
    else:
        way_m, gained_n, mean_n = _dahl(free_m, by_force, stiffness / width_n, left_n)
    end_m_per_s = velocity_m_per_s * exp(-rate * step_s)
    return SlipEnd(way_m, end_m_per_s + (surplus_n - mean_n) / mass_kg * by_speed_s, gained_n)


def advance_bristle_n(
    presliding: Presliding, force_n: float, lower_n: float, upper_n: float, way_m: float
) -> float:
    """Return a bristle's force after a given way within the band [lower, upper].

    Unloaded bristles (infinite) start in the middle of the band.
    """
    held_n = clamp_bristle_n(force_n, 0.5 * (lower_n + upper_n), lower_n, upper_n)
    bent = way_m / presliding.compliance_m_per_n
    if presliding.form == ELASTO_PLASTIC:
        return min(max(held_n + bent, lower_n), upper_n)
    limit_n = upper_n if way_m > 0.0 else lower_n
    return limit_n + (held_n - limit_n) * exp(-abs(bent) / (upper_n - lower_n))


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


DESCRIPTION = EffectDescription(
    name="presliding",
    kind=Presliding,
    block="mechanics",
    equation="df/dx = sigma_0 within the band (elasto-plastic), or sigma_0 (f_lim - f) / "
    "(f_upper - f_lower) (Dahl), with sigma_1 dz/dt added (LuGre)",
    parameters=(
        size(
            "compliance_m_per_n",
            "m/N",
            2e-4,
            smallest=1e-6,
            start=1e-5,
            meaning="1 / sigma_0, deflection of the bristles per force",
        ),
        shape(
            "form",
            "",
            0.0,
            2.0,
            usual=0.0,
            smallest=1.0,
            meaning="law of the bristle's deflection",
            choices=("elasto_plastic", "dahl", "lugre"),
        ),
        shape(
            "bristle_damping_n_s_per_m",
            "N s/m",
            0.0,
            2000.0,
            usual=0.0,
            smallest=20.0,
            meaning="sigma_1, in the form lugre only",
        ),
    ),
    signature="at reversals only: it moves some micrometres before it slides, and the "
    "force depends on where it reversed; the error grows with pressure",
    best_experiment="multisine-small",
    seen_by=("mechanics",),
    woven=("mechanics",),
    forms=(
        EffectForm("elasto-plastic", ("compliance_m_per_n",), {"form": ELASTO_PLASTIC}),
        EffectForm("Dahl", ("compliance_m_per_n",), {"form": DAHL}),
        EffectForm(
            "LuGre",
            ("compliance_m_per_n", "bristle_damping_n_s_per_m"),
            {"form": LUGRE, "bristle_damping_n_s_per_m": 20.0},
        ),
    ),
    as_terms=(AsTerm("force", "hysteresis", "position"),),
)
