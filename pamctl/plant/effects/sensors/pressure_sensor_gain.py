"""The pressure sensor's scale is wrong."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class PressureSensorGain(NamedTuple):
    """Shown gauge pressure over the true one."""

    gain: float = 1.0


def scale_pressure_pa(
    sensor: PressureSensorGain, pressure_pa: float, atmospheric_pa: float
) -> float:
    """Return what is shown of an absolute pressure."""
    if sensor.gain == 1.0:
        return pressure_pa
    return atmospheric_pa + sensor.gain * (pressure_pa - atmospheric_pa)


DESCRIPTION = EffectDescription(
    name="pressure_sensor_gain",
    block="sensors",
    equation="P_m - P_atm = g (P - P_atm)",
    parameters=(
        size(
            "gain",
            "1",
            1.2,
            smallest=0.006,
            start=1.02,
            meaning="g, shown over true gauge pressure",
            neutral=1.0,
            low=0.8,
        ),
    ),
    signature="an error in proportion to the gauge pressure, at plateaus too; both blocks show it",
    best_experiment="square",
    parts=("sensors",),
    seen_by=("pressure", "mechanics"),
)
