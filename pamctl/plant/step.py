"""The coupled plant of Eq. 9, composed of its two blocks."""

from __future__ import annotations

import math

from pamctl.plant.effects.valve_spool import spool_step
from pamctl.plant.mechanics import mechanics_step
from pamctl.plant.parameters import PlantParameters, PlantState
from pamctl.plant.pressure import middle_pressure_pa, pressure_step


def plant_step(
    p: PlantParameters, state: PlantState, command_v: float, step_s: float
) -> PlantState:
    """Advance Eq. 9 by one step of second order under a constant valve command (V)."""
    spool = p.effects.valve_spool
    half_s = 0.5 * step_s
    opening_v, rate = spool_step(spool, state.spool_v, state.spool_rate_v_per_s, command_v, half_s)
    spool_v, spool_rate = spool_step(spool, opening_v, rate, command_v, half_s)

    x, v, pressure = state.position_m, state.velocity_m_per_s, state.pressure_pa
    middle_pa = middle_pressure_pa(p, pressure, opening_v, x, x + half_s * v, step_s)
    end_m, end_v = mechanics_step(p, x, v, middle_pa, step_s)
    end_pa = pressure_step(p, pressure, middle_pa, opening_v, x, end_m, step_s)
    return PlantState(end_m, end_v, end_pa, spool_v, spool_rate)


def plant_advance(
    p: PlantParameters,
    state: PlantState,
    command_v: float,
    duration_s: float,
    longest_step_s: float,
) -> PlantState:
    """Advance by `duration_s` in equal steps, none longer than `longest_step_s`."""
    # The small allowance keeps a rounding error from adding a step.
    steps = max(1, math.ceil(duration_s / longest_step_s - 1e-6))
    step_s = duration_s / steps
    for _ in range(steps):
        state = plant_step(p, state, command_v, step_s)
    return state
