"""The pressure sensor's zero is wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class PressureSensorOffset(NamedTuple):
    """Shown minus true pressure."""

    offset_pa: float = 0.0


def add_offset_pa(sensor: PressureSensorOffset, pressure_pa: float) -> float:
    """Return the absolute pressure that the sensor shows."""
    return pressure_pa + sensor.offset_pa


def undo_offset_pa(
    sensor: PressureSensorOffset, pressure_pa: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the absolute pressure that a correct zero would show."""
    return pressure_pa - sensor.offset_pa


DESCRIPTION = EffectDescription(
    name="pressure_sensor_offset",
    kind=PressureSensorOffset,
    block="sensors",
    equation="P_m = P + o",
    parameters=(
        size(
            "offset_pa",
            "Pa",
            2e4,
            smallest=1e3,
            start=2e3,
            meaning="o, shown minus true pressure",
            low=-2e4,
        ),
    ),
    signature="at atmospheric pressure the sensor reads another one; both blocks show it",
    best_experiment="square-1",
    seen_by=("pressure", "mechanics"),
    entries=(
        EffectEntry(
            "pressure_reading",
            add_offset_pa,
            after=("pressure_sensor_gain",),
            undo=undo_offset_pa,
        ),
    ),
    actuators=("muscle", "chamber"),
    as_terms=(AsTerm("pressure_sensor", "constant"),),
)
