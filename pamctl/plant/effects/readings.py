"""Effects on the readings of the pressure sensor and the encoder."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    Distinction,
    EffectDescription,
    EffectEntry,
    EffectMemory,
    size,
)
from pamctl.plant.effects.places import follow_with_play, lag_weights

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class EncoderBacklash(NamedTuple):
    """Play between the muscle's end and the encoder's scale."""

    width_m: float = 0.0


class ScaleCarrier(NamedTuple):
    """Where the muscle has pushed the encoder's scale."""

    position_m: float


def start_carrier(position_m: float, pressure_pa: float) -> ScaleCarrier:
    """Return a scale in the middle of its play."""
    return ScaleCarrier(position_m)


def follow_backlash_m(backlash: EncoderBacklash, memory: ScaleCarrier, end: float) -> ScaleCarrier:
    """Follow the muscle with a total slack of `width_m`."""
    return ScaleCarrier(follow_with_play(memory.position_m, end, backlash.width_m))


def show_carrier_m(backlash: EncoderBacklash, memory: ScaleCarrier) -> float:
    """Return the displacement that the encoder reads."""
    return memory.position_m


def undo_backlash_m(
    backlash: EncoderBacklash, shown_m: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return about where the muscle's end is behind the readings.

    A play of the same width is behind the reading what the reading is behind the muscle. So it is
    on either side after half a width; within the play nobody knows, and it goes there gradually.
    """
    from pamctl.kernel.calls import machine

    true_m = shown_m.copy()
    machine(add_slack)(backlash.width_m, true_m)
    return true_m


def add_slack(width_m: float, position_m: Array) -> None:
    """Add to each position by how much a play of its own is behind it."""
    carrier_m = position_m[0]
    for k in range(len(position_m)):
        carrier_m = follow_with_play(carrier_m, position_m[k], width_m)
        position_m[k] += position_m[k] - carrier_m


def restart_behind_play(
    backlash: EncoderBacklash,
    carrier: ScaleCarrier,
    position_m: float,
    velocity_m_per_s: float,
    shown_m: float,
    shown_m_per_s: float,
) -> tuple[float, float, ScaleCarrier]:
    """Return position, velocity and scale behind a measured reading and its rate.

    A reading that moves is pushed: its rate tells the side of the play. One that rests says nothing
    of the motion within the play, which goes on as it was simulated.
    """
    if shown_m_per_s == 0.0:
        slack_m = position_m - carrier.position_m
        return shown_m + slack_m, velocity_m_per_s, ScaleCarrier(shown_m)
    side = 0.5 if shown_m_per_s > 0.0 else -0.5
    return shown_m + side * backlash.width_m, shown_m_per_s, ScaleCarrier(shown_m)


ENCODER_BACKLASH = EffectDescription(
    kind=EncoderBacklash, block="sensors",
    equation="play operator: x - w/2 <= x_m <= x + w/2, x_m moves only when pushed",
    parameters=(
        size("width_m", "m", 1e-3, smallest=12e-6, start=50e-6, meaning="w, width of the play"),
    ),
    signature="a flat spot of constant width at every reversal, at any pressure",
    best_experiment="chirp", seen_by=("pressure", "mechanics"),
    entries=(
        EffectEntry("position_reading", show_carrier_m,
                    memory=EffectMemory(start_carrier, follow_backlash_m), undo=undo_backlash_m),
    ),
)  # fmt: skip


class EncoderScale(NamedTuple):
    """The encoder's scale is wrong: strip, mounting angle, elastic carrier."""

    scale: float = 1.0


def scale_position_m(encoder: EncoderScale, position_m: float) -> float:
    """Return the displacement that is shown."""
    return encoder.scale * position_m


def undo_scale_m(
    encoder: EncoderScale, position_m: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the displacement that a correct scale would show."""
    return position_m / encoder.scale


ENCODER_SCALE = EffectDescription(
    kind=EncoderScale, block="sensors",
    equation="x_m = s x",
    parameters=(
        size("scale", "1", 1.1, smallest=0.004, start=1.01,
             meaning="s, ratio of shown to true displacement", neutral=1.0, low=0.9),
    ),
    signature="an error in proportion to the displacement, at any pressure and speed",
    best_experiment="square-1", seen_by=("mechanics", "pressure"),
    entries=(
        EffectEntry("position_reading", scale_position_m, after=("encoder_backlash",),
                    undo=undo_scale_m),
    ),
    same_as={"direct": ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m")},
    as_terms=(AsTerm("encoder", "gain", "position"),),
)  # fmt: skip


class PressureSensorGain(NamedTuple):
    """The pressure sensor's scale is wrong."""

    gain: float = 1.0


def scale_pressure_pa(
    sensor: PressureSensorGain, pressure_pa: float, atmosphere_pa: float
) -> float:
    """Return the absolute pressure that the sensor shows."""
    if sensor.gain == 1.0:
        return pressure_pa
    return atmosphere_pa + sensor.gain * (pressure_pa - atmosphere_pa)


def undo_gain_pa(
    sensor: PressureSensorGain, pressure_pa: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the absolute pressure that a correct scale would show."""
    return atmosphere_pa + (pressure_pa - atmosphere_pa) / sensor.gain


PRESSURE_SENSOR_GAIN = EffectDescription(
    kind=PressureSensorGain, block="sensors",
    equation="P_m - P_atm = g (P - P_atm)",
    parameters=(
        size("gain", "1", 1.2, smallest=0.006, start=1.02,
             meaning="g, ratio of shown to true gauge pressure", neutral=1.0, low=0.8),
    ),
    signature="an error in proportion to the gauge pressure, also at plateaus; both blocks show it",
    best_experiment="square-1", seen_by=("pressure", "mechanics"),
    entries=(
        EffectEntry("pressure_reading", scale_pressure_pa, after=("pressure_sensor_lag",),
                    undo=undo_gain_pa),
    ),
    as_terms=(AsTerm("pressure_sensor", "gain", "pressure"),),
)  # fmt: skip


class PressureSensorLag(NamedTuple):
    """The pressure sensor, or the tube to it, lags."""

    time_constant_s: float = 0.0


class LaggedPressure(NamedTuple):
    """Absolute pressure that the sensor has reached."""

    pressure_pa: float


def start_lag(position_m: float, pressure_pa: float) -> LaggedPressure:
    """Return a sensor that has caught up."""
    return LaggedPressure(pressure_pa)


def lag_pressure_pa(
    lag: PressureSensorLag, memory: LaggedPressure, begin: float, end: float, step_s: float
) -> LaggedPressure:
    """Follow a pressure that changes linearly from `begin` to `end` (Pa), exactly."""
    kept, weight = lag_weights(lag.time_constant_s, step_s)
    return LaggedPressure(kept * memory.pressure_pa + (1.0 - kept) * begin + weight * (end - begin))


def show_lagged_pa(lag: PressureSensorLag, memory: LaggedPressure) -> float:
    """Return the absolute pressure that the sensor has reached."""
    return memory.pressure_pa


def undo_lag_pa(
    lag: PressureSensorLag, pressure_pa: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the absolute pressure before the lag, from the signal's slope, which adds noise."""
    if lag.time_constant_s <= 0.0 or len(times_s) <= 2:
        return pressure_pa
    import numpy as np  # the process of the control loop, which never calls this, has no numpy

    return pressure_pa + lag.time_constant_s * np.gradient(pressure_pa, times_s)


PRESSURE_SENSOR_LAG = EffectDescription(
    kind=PressureSensorLag, block="sensors",
    equation="tau P_s' + P_s = P",
    parameters=(
        size("time_constant_s", "s", 20e-3, smallest=4e-4, start=1e-3, meaning="tau of the sensor"),
    ),
    signature="the measured pressure is late in the pressure block; the measured motion is early "
    "in the mechanics, by the same time",
    best_experiment="square-1", seen_by=("pressure", "mechanics"),
    entries=(
        EffectEntry("pressure_reading", show_lagged_pa,
                    memory=EffectMemory(start_lag, lag_pressure_pa), undo=undo_lag_pa),
    ),
    told_from={
        "valve_spool": Distinction("fill-and-hold",
                                   "after the valve closes the spool has settled and the sensor "
                                     "still catches up"),
        "command_delay": Distinction("fill-and-hold",
                                     "after the valve closes the delay is over and the sensor "
                                       "still catches up"),
        "dead_volume": Distinction("fill-and-hold",
                                   "a volume matters while air flows, a lag also afterwards"),
    },
)  # fmt: skip


class PressureSensorOffset(NamedTuple):
    """The pressure sensor's zero is wrong."""

    offset_pa: float = 0.0


def add_offset_pa(sensor: PressureSensorOffset, pressure_pa: float) -> float:
    """Return the absolute pressure that the sensor shows."""
    return pressure_pa + sensor.offset_pa


def undo_offset_pa(
    sensor: PressureSensorOffset, pressure_pa: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the absolute pressure that a correct zero would show."""
    return pressure_pa - sensor.offset_pa


PRESSURE_SENSOR_OFFSET = EffectDescription(
    kind=PressureSensorOffset, block="sensors",
    equation="P_m = P + o",
    parameters=(
        size("offset_pa", "Pa", 2e4, smallest=1e3, start=2e3,
             meaning="o, shown minus true pressure", low=-2e4),
    ),
    signature="at atmospheric pressure the sensor reads another one; both blocks show it",
    best_experiment="square-1", seen_by=("pressure", "mechanics"),
    entries=(
        EffectEntry("pressure_reading", add_offset_pa, after=("pressure_sensor_gain",),
                    undo=undo_offset_pa),
    ),
    actuators=("muscle", "chamber", "cylinder"),
    as_terms=(AsTerm("pressure_sensor", "constant"),),
)  # fmt: skip
