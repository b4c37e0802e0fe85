"""The pressure sensor's scale is wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class PressureSensorGain(NamedTuple):
    """Ratio of shown to true gauge pressure."""

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


DESCRIPTION = EffectDescription(
    name="pressure_sensor_gain",
    kind=PressureSensorGain,
    block="sensors",
    equation="P_m - P_atm = g (P - P_atm)",
    parameters=(
        size(
            "gain",
            "1",
            1.2,
            smallest=0.006,
            start=1.02,
            meaning="g, ratio of shown to true gauge pressure",
            neutral=1.0,
            low=0.8,
        ),
    ),
    signature="an error in proportion to the gauge pressure, also at plateaus; both blocks show it",
    best_experiment="square-1",
    seen_by=("pressure", "mechanics"),
    entries=(
        EffectEntry(
            "pressure_reading",
            scale_pressure_pa,
            after=("pressure_sensor_lag",),
            undo=undo_gain_pa,
        ),
    ),
    as_terms=(AsTerm("pressure_sensor", "gain", "pressure"),),
)
