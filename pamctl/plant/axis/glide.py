"""Exact motion of a mass under constant forces, for any mass and any damping."""

from __future__ import annotations

from math import exp, expm1, log1p
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pamctl.plant.paper.friction import AxialForces


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
