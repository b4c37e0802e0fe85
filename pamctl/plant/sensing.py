"""What the sensors make of pressure and position, before noise and rounding."""

from __future__ import annotations

from pamctl.plant.effects.sensors.encoder_backlash import follow_backlash_m
from pamctl.plant.effects.sensors.pressure_sensor_gain import scale_pressure_pa
from pamctl.plant.effects.sensors.pressure_sensor_lag import lag_pressure_pa
from pamctl.plant.parameters import AirState, PlantParameters, SensorState


def sensors_step(
    p: PlantParameters,
    sensors: SensorState,
    begin_pa: float,
    end_pa: float,
    position_m: float,
    step_s: float,
) -> SensorState:
    """Let the sensors follow for a step that ends at `position_m`, with `end_pa` at the sensor."""
    e = p.effects.sensors
    return SensorState(
        lag_pressure_pa(e.pressure_sensor_lag, sensors.lagged_pa, begin_pa, end_pa, step_s),
        follow_backlash_m(e.encoder_backlash, sensors.geared_m, position_m),
    )


def pressure_at_sensor_pa(p: PlantParameters, pressure_pa: float, air: AirState) -> float:
    """Return the absolute pressure where the sensor sits: at the valve's end of a line."""
    return (
        air.line_pa if p.effects.air.line_restriction.resistance_pa_s_per_kg > 0.0 else pressure_pa
    )


def sensed_pressure_pa(
    p: PlantParameters, pressure_pa: float, air: AirState, sensors: SensorState
) -> float:
    """Return the absolute pressure that the sensor shows."""
    at_sensor_pa = pressure_at_sensor_pa(p, pressure_pa, air)
    if not p.sensors_act:
        return at_sensor_pa
    e = p.effects.sensors
    if e.pressure_sensor_lag.time_constant_s > 0.0:
        at_sensor_pa = sensors.lagged_pa
    shown_pa = scale_pressure_pa(
        e.pressure_sensor_gain, at_sensor_pa, p.paper.atmospheric_pressure_pa
    )
    return shown_pa + e.pressure_sensor_offset.offset_pa


def sensed_position_m(p: PlantParameters, position_m: float, sensors: SensorState) -> float:
    """Return the displacement that the encoder shows."""
    if not p.sensors_act:
        return position_m
    if p.effects.sensors.encoder_backlash.width_m > 0.0:
        position_m = sensors.geared_m
    return p.effects.sensors.encoder_scale.scale * position_m
