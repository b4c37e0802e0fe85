"""The mechanical block: pressure in, motion out.

The fast pole (c + mu_k N A_b P_g) / M is 2e4 1/s, and friction jumps at zero velocity. RK4 would
need eight sub-steps a millisecond to be stable, and is of first order at the jump. With the forces
held at their values of the step's middle, the motion is a known exponential, and so is the moment
at which it comes to rest.
"""

from __future__ import annotations

from math import exp, log

from pamctl.plant.paper.friction import AxialForces, axial_forces
from pamctl.plant.parameters import PaperParameters


def mechanics_step(
    p: PaperParameters,
    position_m: float,
    velocity_m_per_s: float,
    middle_pressure_pa: float,
    step_s: float,
) -> tuple[float, float]:
    """Advance (x, v) of Eq. 6 by one exponential midpoint step.

    `middle_pressure_pa` is the absolute pressure in the middle of the step.
    """
    middle_m = position_m + 0.5 * step_s * velocity_m_per_s
    forces = axial_forces(p, middle_m, middle_pressure_pa)
    return slide(forces, p.mass_kg, position_m, velocity_m_per_s, step_s)


def slide(
    forces: AxialForces, mass_kg: float, position_m: float, velocity_m_per_s: float, step_s: float
) -> tuple[float, float]:
    """Move exactly under constant forces, also through a stop and a reversal.

    Returns position (m) and velocity (m/s) after `step_s`.
    """
    if velocity_m_per_s == 0.0:
        return leave_rest(forces, mass_kg, position_m, step_s)
    if velocity_m_per_s > 0.0:
        damping = forces.damping_up_n_s_per_m
        terminal = (forces.drive_n - forces.upper_n) / damping
    else:
        damping = forces.damping_down_n_s_per_m
        terminal = (forces.drive_n - forces.lower_n) / damping
    rate = damping / mass_kg
    excess = velocity_m_per_s - terminal
    decay = exp(-rate * step_s)
    velocity = terminal + excess * decay
    # Compare signs: the product would underflow at the end of a decaying motion.
    if velocity != 0.0 and (velocity > 0.0) == (velocity_m_per_s > 0.0):
        return position_m + terminal * step_s + excess * (1.0 - decay) / rate, velocity
    # It comes to rest within the step; then friction decides whether it sticks.
    stop_s = min(log(excess / -terminal) / rate, step_s) if terminal != 0.0 else step_s
    rest_m = position_m + terminal * stop_s + velocity_m_per_s / rate
    return leave_rest(forces, mass_kg, rest_m, step_s - stop_s)


def leave_rest(
    forces: AxialForces, mass_kg: float, position_m: float, step_s: float
) -> tuple[float, float]:
    """Stick while the drive lies in the friction band, else accelerate out of it."""
    if forces.rest_lower_n <= forces.drive_n <= forces.rest_upper_n:
        return position_m, 0.0
    if forces.drive_n > forces.upper_n:
        damping = forces.damping_up_n_s_per_m
        terminal = (forces.drive_n - forces.upper_n) / damping
    else:
        damping = forces.damping_down_n_s_per_m
        terminal = (forces.drive_n - forces.lower_n) / damping
    rate = damping / mass_kg
    growth = 1.0 - exp(-rate * step_s)
    return position_m + terminal * (step_s - growth / rate), terminal * growth
