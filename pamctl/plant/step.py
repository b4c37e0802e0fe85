"""The plant of Eq. 9: two blocks, which can run alone, and the coupled step made of them."""

from __future__ import annotations

import math

from pamctl.plant.chains import add_flow
from pamctl.plant.chamber import AirBegin, chamber_middle_pa, chamber_step
from pamctl.plant.mechanism import mechanism_step
from pamctl.plant.paper.mechanics import mechanics_step
from pamctl.plant.paper.pressure import middle_pressure_pa, pressure_step
from pamctl.plant.parameters import (
    AirNow,
    AirState,
    MechanicsState,
    PlantParameters,
    PlantState,
    ValveState,
    find_tank_pa,
)
from pamctl.plant.sensing import pressure_at_sensor_pa, sensors_step
from pamctl.plant.terms.air_terms import add_flow_term
from pamctl.plant.valve_chain import valve_step


def plant_step(
    p: PlantParameters, state: PlantState, command_v: float, step_s: float
) -> PlantState:
    """Advance Eq. 9 by one second-order step under a constant valve command (V).

    The pressure block predicts the pressure in the middle, the mechanics move under it, and
    the pressure block completes its step with the motion.
    """
    x, v, pressure_pa, valve, air, sensors, mechanics, age_s = state
    opening_v = command_v
    if p.valve_acts:
        opening_v, valve = valve_step(p.effects.valve, p.terms, valve, command_v, age_s, step_s)
    middle_m = x + 0.5 * step_s * v
    begin = AirBegin(pressure_pa, air, opening_v, x, middle_m, age_s, step_s)
    middle_pa, balanced = air_middle_pa(p, begin)
    end_m, end_v, mechanics = mechanics_block_step(
        p, x, v, mechanics, middle_pa, 0.0, age_s, step_s
    )
    end_pa, end_air = air_step(p, begin, middle_pa, balanced, end_m)
    if p.sensors_act:
        begin_pa = pressure_at_sensor_pa(p, pressure_pa, air)
        at_sensor_pa = pressure_at_sensor_pa(p, end_pa, end_air)
        sensors = sensors_step(p, sensors, begin_pa, at_sensor_pa, x, end_m, age_s, step_s)
    return PlantState(end_m, end_v, end_pa, valve, end_air, sensors, mechanics, age_s + step_s)


def pressure_block_step(
    p: PlantParameters,
    pressure_pa: float,
    valve: ValveState,
    air: AirState,
    command_v: float,
    position_m: float,
    middle_m: float,
    end_m: float,
    age_s: float,
    step_s: float,
) -> tuple[float, ValveState, AirState]:
    """Advance the pressure block alone: the muscle's positions (m) are given.

    `middle_m` is the expected position at the middle of the step. With x + v h / 2, and the true
    position at the end, the result equals the coupled step's pressure to the bit. A measurement
    has no velocity; use the mean of both ends.
    """
    opening_v = command_v
    if p.valve_acts:
        opening_v, valve = valve_step(p.effects.valve, p.terms, valve, command_v, age_s, step_s)
    begin = AirBegin(pressure_pa, air, opening_v, position_m, middle_m, age_s, step_s)
    middle_pa, balanced = air_middle_pa(p, begin)
    end_pa, air = air_step(p, begin, middle_pa, balanced, end_m)
    return end_pa, valve, air


def mechanics_block_step(
    p: PlantParameters,
    position_m: float,
    velocity_m_per_s: float,
    mechanics: MechanicsState,
    middle_pa: float,
    middle_n: float,
    age_s: float,
    step_s: float,
) -> tuple[float, float, MechanicsState]:
    """Advance the mechanics alone under a given load; without effects, by the paper's equations.

    The load is the absolute pressure (Pa) in the middle of the step, for a direct mechanism also
    the force (N).
    """
    if p.mechanics_act:
        return mechanism_step(
            p, position_m, velocity_m_per_s, mechanics, middle_pa, middle_n, age_s, step_s
        )
    end_m, end_v = mechanics_step(p.paper, position_m, velocity_m_per_s, middle_pa, step_s)
    return end_m, end_v, mechanics


def air_middle_pa(p: PlantParameters, begin: AirBegin) -> tuple[float, bool]:
    """Predict the pressure at the step's middle; without effects, by the paper's equations."""
    pressure_pa, position_m, middle_m = begin.pressure_pa, begin.position_m, begin.middle_m
    if p.air_acts:
        now = find_air_now(p, begin, pressure_pa, position_m, begin.age_s)
        return chamber_middle_pa(p, now, begin)
    middle_pa = middle_pressure_pa(
        p.paper, pressure_pa, begin.opening_v, position_m, middle_m, begin.step_s
    )
    return middle_pa, False


def air_step(
    p: PlantParameters, begin: AirBegin, middle_pa: float, balanced: bool, end_m: float
) -> tuple[float, AirState]:
    """Complete the pressure's step with the muscle's true motion."""
    pressure_pa, position_m, step_s = begin.pressure_pa, begin.position_m, begin.step_s
    if p.air_acts:
        age_s = begin.age_s + 0.5 * step_s
        now = find_air_now(p, begin, middle_pa, begin.middle_m, age_s)
        return chamber_step(p, now, begin, middle_pa, balanced, end_m)
    end_pa = pressure_step(
        p.paper, pressure_pa, middle_pa, begin.opening_v, position_m, end_m, step_s
    )
    return end_pa, begin.air


def find_air_now(
    p: PlantParameters, begin: AirBegin, pressure_pa: float, position_m: float, age_s: float
) -> AirNow:
    """Return what acts on the air, with the extra flow at a point of the step."""
    opening_v = begin.opening_v
    extra = add_flow(p.effects.air, 0.0, opening_v, pressure_pa, position_m, age_s)
    gauge_pa = pressure_pa - p.paper.atmospheric_pressure_pa
    extra = add_flow_term(p.terms, extra, opening_v, gauge_pa, position_m, age_s)
    return AirNow(extra, find_tank_pa(p, age_s))


def advance_plant(
    p: PlantParameters,
    state: PlantState,
    command_v: float,
    duration_s: float,
    longest_step_s: float,
) -> PlantState:
    """Advance by `duration_s` in equal steps, none longer than `longest_step_s`."""
    steps = count_steps(duration_s, longest_step_s)
    step_s = duration_s / steps
    for _ in range(steps):
        state = plant_step(p, state, command_v, step_s)
    return state


def count_steps(duration_s: float, longest_step_s: float) -> int:
    """Return the number of equal steps; the tolerance keeps rounding from adding one."""
    return max(1, math.ceil(duration_s / longest_step_s - 1e-6))
