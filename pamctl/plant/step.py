"""The plant of Eq. 9: two blocks, which can run alone, and the coupled step made of them."""

from __future__ import annotations

import math
from typing import Any

from pamctl.plant.catalogue import (
    follow_command,
    follow_opening,
    follow_position_reading,
    follow_pressure_reading,
    pass_command,
    pass_opening,
    pass_position_reading,
    pass_pressure_reading,
)
from pamctl.plant.chamber import AirBegin, chamber_middle_pa, chamber_step
from pamctl.plant.effects.air import restricts
from pamctl.plant.effects.valve import spool_step
from pamctl.plant.mechanism import mechanism_step
from pamctl.plant.paper import mechanics_step, middle_pressure_pa, pressure_step
from pamctl.plant.parameters import (
    AirState,
    MechanicsState,
    PlantParameters,
    PlantState,
    ValveState,
)
from pamctl.plant.terms import (
    Terms,
    follow_value,
    pass_command_term,
    pass_opening_term,
    show_position_term,
    show_pressure_term,
)


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
    middle_n = p.drive_n_per_v * opening_v
    end_m, end_v, mechanics = mechanics_block_step(
        p, x, v, mechanics, middle_pa, middle_n, age_s, step_s
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
        return chamber_middle_pa(p, begin)
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
        return chamber_step(p, begin, middle_pa, balanced, end_m)
    end_pa = pressure_step(
        p.paper, pressure_pa, middle_pa, begin.opening_v, position_m, end_m, step_s
    )
    return end_pa, begin.air


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


LONG_S = 10.0
"""A valve has settled after this time."""


def settle_valve(e: Any, terms: Terms | None, valve: ValveState, command_v: float) -> ValveState:
    """Return the valve's state after it has had a command (V) for long."""
    memory = follow_command(e, valve.memory, command_v, command_v, LONG_S, 0.0)
    spool_v = pass_command(e, memory, command_v, 0.0)
    spool_v, term = pass_command_term(terms, valve.term, spool_v, 0.0, LONG_S)
    memory = follow_opening(e, memory, spool_v, spool_v, LONG_S, 0.0)
    return ValveState(spool_v, 0.0, memory, term)


def valve_step(
    e: Any, terms: Terms | None, valve: ValveState, command_v: float, age_s: float, step_s: float
) -> tuple[float, ValveState]:
    """Return the opening in the middle of the step, and the valve's state at its end.

    `e` are the `ValveEffects`. The opening is that of the paper's valve with the same area, in
    volts of command.
    """
    half_s = 0.5 * step_s
    middle_age_s = age_s + half_s
    memory = follow_command(e, valve.memory, command_v, command_v, half_s, middle_age_s)
    pushed_v = pass_command(e, memory, command_v, middle_age_s)
    memory = follow_command(e, memory, command_v, command_v, half_s, middle_age_s)
    asked_v = pushed_v
    pushed_v, term = pass_command_term(terms, valve.term, asked_v, middle_age_s, half_s)
    if terms is not None and term is not None:
        term = follow_value(terms.valve, term, asked_v, asked_v, half_s)
    middle_v, rate = spool_step(
        e.valve_spool, valve.spool_v, valve.spool_rate_v_per_s, pushed_v, half_s
    )
    spool_v, spool_rate = spool_step(e.valve_spool, middle_v, rate, pushed_v, half_s)
    memory = follow_opening(e, memory, middle_v, middle_v, half_s, middle_age_s)
    opening_v = pass_opening(e, memory, middle_v, middle_age_s)
    opening_v = pass_opening_term(terms, opening_v, middle_age_s)
    memory = follow_opening(e, memory, middle_v, middle_v, half_s, middle_age_s)
    return opening_v, ValveState(spool_v, spool_rate, memory, term)


def sensors_step(
    p: PlantParameters,
    sensors: Any,
    begin_pa: float,
    end_pa: float,
    begin_m: float,
    end_m: float,
    age_s: float,
    step_s: float,
) -> Any:
    """Return the `SensorMemory` after a step of linear change; `..._pa` are at the sensor."""
    if not p.sensors_act:
        return sensors
    e, atmosphere_pa = p.effects.sensors, p.paper.atmospheric_pressure_pa
    sensors = follow_pressure_reading(e, sensors, begin_pa, end_pa, step_s, atmosphere_pa, age_s)
    return follow_position_reading(e, sensors, begin_m, end_m, step_s, age_s)


def pressure_at_sensor_pa(p: PlantParameters, pressure_pa: float, air: AirState) -> float:
    """Return the absolute pressure at the sensor, which is at the line's valve end."""
    return air.line_pa if restricts(p.effects.air.line_restriction) else pressure_pa


def sensed_pressure_pa(
    p: PlantParameters, pressure_pa: float, air: AirState, sensors: Any, age_s: float
) -> float:
    """Return the absolute pressure that the sensor shows."""
    at_sensor_pa = pressure_at_sensor_pa(p, pressure_pa, air)
    if not p.sensors_act:
        return at_sensor_pa
    atmosphere_pa = p.paper.atmospheric_pressure_pa
    shown_pa: float = pass_pressure_reading(
        p.effects.sensors, sensors, at_sensor_pa, atmosphere_pa, age_s
    )
    return show_pressure_term(p.terms, shown_pa, atmosphere_pa, age_s)


def sensed_position_m(p: PlantParameters, position_m: float, sensors: Any, age_s: float) -> float:
    """Return the displacement that the encoder shows."""
    if not p.sensors_act:
        return position_m
    shown_m: float = pass_position_reading(p.effects.sensors, sensors, position_m, age_s)
    return show_position_term(p.terms, shown_m, age_s)
