"""Counts to metres, volts to pascals, command to output volts: pure and invertible.

Chain of the paper's rig: an MPX5700GP pressure sensor (gauge, ratiometric), an EM2
encoder decoded four times per cycle, and a D1 valve driver that takes 0 to 10 V with
5 V as null. A converter clamps a voltage to its range and rounds it to a code. The functions on
NamedTuples are kernels: plain scalar arithmetic.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field


class Configured(BaseModel):
    """Immutable; an unknown key, NaN or infinity is an error, never a silent default."""

    # Built at first use: most models are only parts of one that is used.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


class CalibrationSettings(Configured):
    """How raw volts and counts relate to SI; defaults are the data sheets' nominal values."""

    sensor_zero_v: Annotated[
        float,
        Field(ge=0.0, le=1.0, description="output at atmospheric pressure, refined by homing"),
    ] = 0.2
    sensor_zero_lowest_v: Annotated[float, Field(ge=0.0, le=1.0)] = 0.184
    sensor_zero_highest_v: Annotated[
        float, Field(ge=0.0, le=1.0, description="homing refuses a zero outside these two")
    ] = 0.409
    sensor_pa_per_v: Annotated[
        float,
        Field(ge=1.0, le=1e9, description="MPX5700 at 5 V supply: 1 / (5 V x 1.2858e-6 1/Pa)"),
    ] = 1.0 / (5.0 * 1.2858e-6)
    atmospheric_pressure_pa: Annotated[float, Field(gt=5e4, lt=1.2e5)] = 101.3e3
    encoder_m_per_count: Annotated[
        float, Field(ge=1e-9, lt=1e-2, description="EM2, 2000 cycles an inch, X4: 25.4 mm / 8000")
    ] = 25.4e-3 / 8000.0
    encoder_sign: Annotated[
        Literal[1, -1], Field(description="1 where counts rise as the muscle contracts, else -1")
    ] = 1
    driver_offset_v: Annotated[
        float, Field(ge=-10, le=10, description="output voltage at which the valve is closed")
    ] = 5.0
    driver_gain: Annotated[float, Field(ge=1e-3, le=10, description="output V per command V")] = 1.0
    driver_low_v: Annotated[float, Field(ge=-10, le=10, description="lowest V it takes")] = 0.0
    driver_high_v: Annotated[float, Field(ge=-10, le=10, description="highest V it takes")] = 10.0


class Calibration(NamedTuple):
    """The numbers of `CalibrationSettings` that the kernels need."""

    sensor_pa_per_v: float
    atmospheric_pressure_pa: float
    encoder_m_per_count: float
    """Signed: positive where counts rise as the muscle contracts."""
    driver_offset_v: float
    driver_gain: float


class Zero(NamedTuple):
    """The sensors' readings at the vented muscle; every homing takes them again."""

    sensor_zero_v: float
    encoder_zero_counts: float


def calibration(settings: CalibrationSettings) -> Calibration:
    """Turn settings into the numbers that the kernels use."""
    return Calibration(
        sensor_pa_per_v=settings.sensor_pa_per_v,
        atmospheric_pressure_pa=settings.atmospheric_pressure_pa,
        encoder_m_per_count=settings.encoder_m_per_count * settings.encoder_sign,
        driver_offset_v=settings.driver_offset_v,
        driver_gain=settings.driver_gain,
    )


def pressure_pa(cal: Calibration, zero: Zero, sensor_v: float) -> float:
    """Absolute pressure from the sensor's voltage."""
    return cal.atmospheric_pressure_pa + (sensor_v - zero.sensor_zero_v) * cal.sensor_pa_per_v


def sensor_v(cal: Calibration, zero: Zero, pressure_pa: float) -> float:
    """Voltage of the sensor at an absolute pressure: the inverse of `pressure_pa`."""
    return zero.sensor_zero_v + (pressure_pa - cal.atmospheric_pressure_pa) / cal.sensor_pa_per_v


def position_m(cal: Calibration, zero: Zero, counts: float) -> float:
    """Displacement from the encoder's counts; contraction is positive."""
    return (counts - zero.encoder_zero_counts) * cal.encoder_m_per_count


def encoder_counts(cal: Calibration, zero: Zero, position_m: float) -> float:
    """Counts, not yet rounded, at a displacement: the inverse of `position_m`."""
    return zero.encoder_zero_counts + position_m / cal.encoder_m_per_count


def output_v(cal: Calibration, valve_v: float) -> float:
    """Output voltage that carries a valve command: 5 + u on the paper's driver."""
    return cal.driver_offset_v + cal.driver_gain * valve_v


def valve_v(cal: Calibration, output_v: float) -> float:
    """Valve command that an output voltage carries: the inverse of `output_v`."""
    return (output_v - cal.driver_offset_v) / cal.driver_gain


class Converter(NamedTuple):
    """An ideal bipolar 16-bit converter of a given full scale, as the PCI-6221's are."""

    full_scale_v: float
    levels: float = 65536.0


def quantise_v(converter: Converter, volts: float) -> float:
    """Return the voltage of the nearest code, at most one step below full scale."""
    full_scale_v, levels = converter
    step = 2.0 * full_scale_v / levels
    # Clamped first: a huge voltage has no integer code to be rounded to.
    if volts >= full_scale_v - step:
        return full_scale_v - step
    if volts <= -full_scale_v:
        return -full_scale_v
    return math.floor(volts / step + 0.5) * step


class Output(NamedTuple):
    """An analog output that is kept within a range; both ends are codes of its converter."""

    converter: Converter
    lowest_v: float
    highest_v: float


def make_output(converter: Converter, low_v: float, high_v: float) -> Output:
    """Return an output that reaches from the lowest to the highest code between two voltages."""
    step = 2.0 * converter.full_scale_v / converter.levels
    return Output(
        converter,
        quantise_v(converter, math.ceil(low_v / step) * step),
        quantise_v(converter, math.floor(high_v / step) * step),
    )


def nearest_output_v(output: Output, volts: float) -> float:
    """Return the voltage that an output really applies when told `volts`."""
    return min(max(quantise_v(output.converter, volts), output.lowest_v), output.highest_v)
