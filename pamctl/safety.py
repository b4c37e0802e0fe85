"""What may reach the valve, and why not more.

Every rule compares a number with a limit that a user can set, and leaves its bit in
`Decision.verdicts`. A clip changes the command. A trip ends the run at the safe voltage, and
stays. `admit` is a kernel: it reads no clock, and its memory is its `SafetyState`.
"""

from __future__ import annotations

import math
from collections import namedtuple
from math import isfinite, isnan
from typing import TYPE_CHECKING, Annotated, NamedTuple

from pydantic import Field, model_validator

from hal.calibration import Configured
from hal.rig import RawSample
from pamctl.plant.paper import PaperParameters, valve_flow, volume_m3
from pamctl.signals import Command, Decision, Estimate, Measurement, Phase, Reference, Timing

# Clips
ENVELOPE = 1 << 0
SLEW = 1 << 1
PINNED = 1 << 2
# Trips
COMMAND_NOT_FINITE = 1 << 8
MEASUREMENT_NOT_FINITE = 1 << 9
PRESSURE_LIMIT = 1 << 10
STROKE_LIMIT = 1 << 11
SENSOR_RANGE = 1 << 12
ENCODER_JUMP = 1 << 13
TRACKING_ERROR = 1 << 14
STALE_SAMPLE = 1 << 15
OVERRUNS = 1 << 16
PRESSURE_TOO_LOW = 1 << 17
PRESSURE_TOO_HIGH = 1 << 18

VERDICTS: dict[int, str] = {
    ENVELOPE: "command cut to the valve's range",
    SLEW: "command slowed to the slew limit",
    PINNED: "output pinned to the safe voltage (--readonly), whatever the law asks for",
    COMMAND_NOT_FINITE: "the command is not a finite number",
    MEASUREMENT_NOT_FINITE: "a sensor gave no finite number",
    PRESSURE_LIMIT: "pressure above its limit",
    STROKE_LIMIT: "displacement outside its limits",
    SENSOR_RANGE: "pressure sensor outside its electrical range (broken wire?)",
    ENCODER_JUMP: "encoder moved faster than the muscle can",
    TRACKING_ERROR: "tracking error above its limit for too long",
    STALE_SAMPLE: "no fresh sample",
    OVERRUNS: "too many missed ticks",
    PRESSURE_TOO_LOW: "pressure below what the command should have given (valve stuck? leak?)",
    PRESSURE_TOO_HIGH: "pressure above what the command should have given (valve stuck?)",
}
"""Meaning of each bit of `Decision.verdicts`."""


def explain_verdicts(verdicts: int) -> list[str]:
    """Name every bit that is set."""
    return [meaning for bit, meaning in VERDICTS.items() if verdicts & bit]


class LimitSettings(Configured):
    """Limits of the rig and its muscle. `pamctl.safety.VERDICTS` names the rules that use them."""

    command_v: Annotated[float, Field(gt=0, le=10, description="valve command, either side")] = 5.0
    slew_v_per_s: Annotated[
        float,
        Field(gt=0, le=1e6, description="of laws; open-loop steps and safe writes are exempt"),
    ] = 10_000.0
    pressure_pa: Annotated[float, Field(gt=0, le=2e6, description="absolute")] = 500e3
    stroke_low_mm: Annotated[float, Field(ge=-100, le=0)] = -2.0
    stroke_high_mm: Annotated[float, Field(gt=0, le=500)] = 30.0
    sensor_low_v: Annotated[float, Field(ge=-10, le=10)] = 0.1
    sensor_high_v: Annotated[float, Field(ge=-10, le=10)] = 4.8
    speed_mm_per_s: Annotated[
        float, Field(gt=0, le=1e5, description="a faster motion is an error of the encoder")
    ] = 2000.0
    tracking_error_mm: Annotated[float, Field(gt=0, le=1000)] = 4.0
    sample_age_s: Annotated[float, Field(gt=0, le=60, description="between samples")] = 0.05
    missed_ticks: Annotated[
        float, Field(gt=0, le=1e6, description="the most within about a second")
    ] = 100.0
    pressure_model_pa: Annotated[
        float, Field(gt=0, le=2e6, description="measured against the model driven by the command")
    ] = 80e3
    pressure_model_memory_s: Annotated[
        float, Field(ge=0.01, le=10, description="how fast the model forgets a difference")
    ] = 0.1
    pressure_model_step_s: Annotated[
        float, Field(ge=1e-4, le=1, description="a longer tick is cut into such steps of the model")
    ] = 2e-3
    patience_s: Annotated[
        float,
        Field(ge=0, le=1, description="how long a sensor, error or model limit may be broken"),
    ] = 0.02

    @model_validator(mode="after")
    def _ordered(self) -> LimitSettings:
        if self.sensor_low_v >= self.sensor_high_v:
            raise ValueError("sensor_low_v must be below sensor_high_v")
        return self


def _name_in_si(name: str) -> str:
    return name.replace("_mm", "_m")


if TYPE_CHECKING:

    class Limits(LimitSettings):
        """The limits in SI for the kernel, with the model that the pressure is held against."""

        stroke_low_m: float
        stroke_high_m: float
        speed_m_per_s: float
        tracking_error_m: float
        safe_valve_v: float
        pinned: bool
        """Only the safe command may reach the valve: the run moves nothing."""
        count_m: float
        """One count of the encoder."""
        model: PaperParameters

else:
    # Kernels take tuples. The names of the settings are written once, in their model.
    Limits = namedtuple(
        "Limits",
        (
            *map(_name_in_si, LimitSettings.model_fields),
            "safe_valve_v",
            "pinned",
            "count_m",
            "model",
        ),
    )


class SafetyState(NamedTuple):
    """What safety remembers: NaN where there is no previous tick."""

    valve_v: float
    position_m: float
    model_pressure_pa: float
    sensor_bad_s: float
    error_bad_s: float
    model_bad_s: float
    missed_ticks: float
    tripped: int


INITIAL_SAFETY_STATE = SafetyState(math.nan, math.nan, math.nan, 0.0, 0.0, 0.0, 0.0, 0)
"""The state before the first tick."""


def convert_limits(
    settings: LimitSettings,
    *,
    safe_valve_v: float,
    count_m: float,
    model: PaperParameters,
    pinned: bool = False,
) -> Limits:
    """Return the limits for the kernel; `count_m` is one encoder count."""
    numbers = {
        _name_in_si(name): value * 1e-3 if "_mm" in name else value
        for name, value in settings.model_dump().items()
    }
    return Limits(**numbers, safe_valve_v=safe_valve_v, pinned=pinned, count_m=count_m, model=model)


_HOMING = int(Phase.HOMING)
MOST_MODEL_STEPS = 50
"""Steps of the pressure model in one interval; with more the sample is stale by any limit."""


def admit(
    limits: Limits,
    state: SafetyState,
    raw: RawSample,
    measurement: Measurement,
    reference: Reference,
    estimate: Estimate,
    command: Command,
    timing: Timing,
) -> tuple[Decision, SafetyState]:
    """Decide what reaches the valve in this tick."""
    dt_s = timing.dt_s
    trips = _check_instant_trips(limits, state, measurement, reference, command, dt_s)

    # Sensor, error and model limits may be broken for `patience_s`; each has its own time.
    sensor_bad_s = error_bad_s = model_bad_s = 0.0
    if not limits.sensor_low_v <= raw.pressure_v <= limits.sensor_high_v:
        sensor_bad_s = state.sensor_bad_s + dt_s
        if sensor_bad_s > limits.patience_s:
            trips |= SENSOR_RANGE
    # A pinned valve cannot track.
    if not limits.pinned and abs(estimate.error_m) > limits.tracking_error_m:
        error_bad_s = state.error_bad_s + dt_s
        if error_bad_s > limits.patience_s:
            trips |= TRACKING_ERROR
    model_pa, excess_pa = _follow_pressure(limits, state, measurement, dt_s)
    if abs(excess_pa) > limits.pressure_model_pa:
        model_bad_s = state.model_bad_s + dt_s
        if model_bad_s > limits.patience_s:
            trips |= PRESSURE_TOO_HIGH if excess_pa > 0.0 else PRESSURE_TOO_LOW
    # Missed ticks are forgotten with a time constant of a second.
    missed_ticks = state.missed_ticks * (1.0 - dt_s) + timing.missed
    if missed_ticks > limits.missed_ticks:
        trips |= OVERRUNS

    tripped = state.tripped | trips
    clips = 0
    valve_v = limits.safe_valve_v
    if not tripped:
        if limits.pinned:
            clips = PINNED
        else:
            valve_v, clips = _clip_command(limits, state, reference, command.command_v, dt_s)
    return (
        Decision(valve_v, tripped | clips, tripped != 0),
        SafetyState(
            valve_v,
            measurement.position_m,
            model_pa,
            sensor_bad_s,
            error_bad_s,
            model_bad_s,
            missed_ticks,
            tripped,
        ),
    )


def _check_instant_trips(
    limits: Limits,
    state: SafetyState,
    measurement: Measurement,
    reference: Reference,
    command: Command,
    dt_s: float,
) -> int:
    """Check the rules that trip at once."""
    trips = 0
    x, pressure = measurement
    if not isfinite(command.command_v):
        trips |= COMMAND_NOT_FINITE
    if not isfinite(x + pressure):
        trips |= MEASUREMENT_NOT_FINITE
    if pressure > limits.pressure_pa:
        trips |= PRESSURE_LIMIT
    # Before homing the encoder's zero is wherever the counter stood.
    if reference.phase != _HOMING and not limits.stroke_low_m <= x <= limits.stroke_high_m:
        trips |= STROKE_LIMIT
    if abs(x - state.position_m) > limits.speed_m_per_s * dt_s + 4.0 * limits.count_m:
        trips |= ENCODER_JUMP
    if not 0.0 < dt_s <= limits.sample_age_s:
        trips |= STALE_SAMPLE
    return trips


def _clip_command(
    limits: Limits, state: SafetyState, reference: Reference, command_v: float, dt_s: float
) -> tuple[float, int]:
    """Cut to the envelope, then to the slew limit; open-loop steps may be steps."""
    clips = 0
    valve_v = command_v
    if abs(valve_v) > limits.command_v:
        clips |= ENVELOPE
        valve_v = math.copysign(limits.command_v, valve_v)
    if isnan(reference.reference_valve_v):
        change_v = valve_v - state.valve_v
        reach_v = limits.slew_v_per_s * dt_s
        if abs(change_v) > reach_v:
            clips |= SLEW
            valve_v = state.valve_v + math.copysign(reach_v, change_v)
    return valve_v, clips


def _count_model_steps(limits: Limits, dt_s: float) -> int:
    """Return how many steps of the pressure model a tick needs: 1 if it is in time.

    The muscle fills in some 50 ms. One step over a late tick would fill it at the first rate all
    the time.
    """
    if not limits.pressure_model_step_s < dt_s < math.inf:
        return 1
    return math.ceil(min(dt_s / limits.pressure_model_step_s, float(MOST_MODEL_STEPS)))


def _follow_pressure(
    limits: Limits, state: SafetyState, measurement: Measurement, dt_s: float
) -> tuple[float, float]:
    """Let the model's pressure follow the last command, and forget differences slowly.

    Returns the model's pressure, and the measured pressure minus it, in Pa. A stuck valve makes
    the two differ; the sign says whether it is stuck open to the tank or to the atmosphere.
    """
    x, measured_pa = measurement
    followed_pa = state.model_pressure_pa
    excess_pa = measured_pa - followed_pa
    if not isfinite(excess_pa):
        return measured_pa, 0.0
    p = limits.model
    volume, last_volume = volume_m3(p, state.position_m), volume_m3(p, x)
    if not last_volume > 0.0:
        # The displacement is impossible: the rules for the encoder trip.
        return measured_pa, 0.0
    steps = _count_model_steps(limits, dt_s)
    for step in range(1, steps + 1):
        energy = followed_pa * volume
        inflow = valve_flow(p, state.valve_v, followed_pa)
        if step < steps:
            volume += (last_volume - volume) / (steps - step + 1)
        else:
            volume = last_volume
        followed_pa = (energy + dt_s / steps * p.specific_energy_j_per_kg * inflow) / volume
        if followed_pa > p.tank_pressure_pa:
            followed_pa = p.tank_pressure_pa
        elif followed_pa < p.atmospheric_pressure_pa:
            followed_pa = p.atmospheric_pressure_pa
    if steps > 1:  # in a late tick the pressure has gone far from the last one
        excess_pa = measured_pa - followed_pa
    forget = dt_s / limits.pressure_model_memory_s
    if forget > 1.0:
        forget = 1.0
    return followed_pa + forget * excess_pa, excess_pa
