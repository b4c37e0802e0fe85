"""The pressure sensor, or the tube to it, lags."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.air.line_restriction import lag_weights
from pamctl.plant.effects.description import (
    Distinction,
    EffectDescription,
    EffectEntry,
    EffectMemory,
    size,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class PressureSensorLag(NamedTuple):
    """Lag of first order."""

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


DESCRIPTION = EffectDescription(
    name="pressure_sensor_lag",
    kind=PressureSensorLag,
    block="sensors",
    equation="tau P_s' + P_s = P",
    parameters=(
        size("time_constant_s", "s", 20e-3, smallest=4e-4, start=1e-3, meaning="tau of the sensor"),
    ),
    signature="the measured pressure is late in the pressure block; the measured motion is early "
    "in the mechanics, by the same time",
    best_experiment="square-1",
    seen_by=("pressure", "mechanics"),
    entries=(
        EffectEntry(
            "pressure_reading",
            show_lagged_pa,
            memory=EffectMemory(start_lag, lag_pressure_pa),
            undo=undo_lag_pa,
        ),
    ),
    told_from={
        "valve_spool": Distinction(
            "fill-and-hold",
            "after the valve closes the spool has settled and the sensor still catches up",
        ),
        "command_delay": Distinction(
            "fill-and-hold",
            "after the valve closes the delay is over and the sensor still catches up",
        ),
        "dead_volume": Distinction(
            "fill-and-hold", "a volume matters while air flows, a lag also afterwards"
        ),
    },
)
