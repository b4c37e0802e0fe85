"""The pressure sensor's zero is wrong."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class PressureSensorOffset(NamedTuple):
    """What the sensor shows too much."""

    offset_pa: float = 0.0


DESCRIPTION = EffectDescription(
    name="pressure_sensor_offset",
    block="sensors",
    equation="P_m = P + o",
    parameters=(
        size(
            "offset_pa",
            "Pa",
            2e4,
            smallest=1e3,
            start=2e3,
            meaning="o, shown at true pressure",
            low=-2e4,
        ),
    ),
    signature="the vented muscle does not read the atmosphere's pressure; both blocks show it",
    best_experiment="square",
    parts=("sensors",),
    seen_by=("pressure", "mechanics"),
)
