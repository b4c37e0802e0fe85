"""The pressure sensor, or the tube to it, follows late."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.air.line_restriction import lag_weights
from pamctl.plant.effects.description import EffectDescription, size


class PressureSensorLag(NamedTuple):
    """Lag of first order."""

    time_constant_s: float = 0.0


def lag_pressure_pa(
    lag: PressureSensorLag, before_pa: float, begin_pa: float, end_pa: float, step_s: float
) -> float:
    """Follow a pressure that goes straight from `begin_pa` to `end_pa`: exact."""
    if lag.time_constant_s <= 0.0:
        return end_pa
    kept, weight = lag_weights(lag.time_constant_s, step_s)
    return kept * before_pa + (1.0 - kept) * begin_pa + weight * (end_pa - begin_pa)


DESCRIPTION = EffectDescription(
    name="pressure_sensor_lag",
    block="sensors",
    equation="tau P_s' + P_s = P",
    parameters=(
        size("time_constant_s", "s", 20e-3, smallest=4e-4, start=1e-3, meaning="tau of the sensor"),
    ),
    signature="the measured pressure is late in the pressure block, and the motion early in the "
    "mechanics, by the same time",
    best_experiment="square",
    parts=("sensors",),
    seen_by=("pressure", "mechanics"),
)
