"""The sensors' readings of pressure and position, before noise and rounding."""

from __future__ import annotations

from typing import Any

from pamctl.plant.chains import (
    follow_position_reading,
    follow_pressure_reading,
    pass_position_reading,
    pass_pressure_reading,
)
from pamctl.plant.effects.air.line_restriction import restricts
from pamctl.plant.parameters import AirState, PlantParameters
from pamctl.plant.terms.sensor_terms import show_position_term, show_pressure_term


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
