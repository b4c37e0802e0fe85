"""A tube between valve and muscle, with resistance and volume; the sensor is at its valve end.

The pressure at the sensor therefore leads the pressure in the muscle.
"""

from __future__ import annotations

from math import exp
from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectForm, shape, size


class LineRestriction(NamedTuple):
    """Laminar resistance of the tube, and its volume, lumped at the valve."""

    resistance_pa_s_per_kg: float = 0.0
    volume_m3: float = 0.0


def line_time_s(line: LineRestriction, specific_energy_j_per_kg: float) -> float:
    """Return the time constant of the line's own volume behind its resistance."""
    return line.resistance_pa_s_per_kg * line.volume_m3 / specific_energy_j_per_kg


def lag_weights(time_s: float, step_s: float) -> tuple[float, float]:
    """Return the weights of a lag over a step: of its last value, and of a ramp of its input.

    y(h) = kept y(0) + (1 - kept) r(0) + weight (r(h) - r(0)) is exact for a linear r.
    """
    if time_s <= 0.0:
        return 0.0, 1.0
    kept = exp(-step_s / time_s)
    return kept, 1.0 - (1.0 - kept) * time_s / step_s


DESCRIPTION = EffectDescription(
    name="line_restriction",
    kind=LineRestriction,
    block="pressure",
    equation="V_l P_1' = R T (m - g),  (P V)' = R T g,  g = (P_1 - P) / R_l,  the sensor sees P_1",
    parameters=(
        size(
            "resistance_pa_s_per_kg",
            "Pa s/kg",
            5e7,
            smallest=1e6,
            start=5e6,
            meaning="R_l, resistance of the tube",
        ),
        shape(
            "volume_m3",
            "m3",
            0.0,
            2e-5,
            usual=0.0,
            smallest=1e-6,
            meaning="V_l, volume at the valve's end",
        ),
    ),
    signature="the measured pressure jumps with the flow, and the motion follows later; both "
    "blocks show it",
    best_experiment="square-1",
    seen_by=("pressure", "mechanics"),
    woven=("air",),
    forms=(
        EffectForm("resistance", free=("resistance_pa_s_per_kg",)),
        EffectForm(
            "resistance and volume",
            free=("resistance_pa_s_per_kg", "volume_m3"),
            held={"volume_m3": 3e-6},
        ),
    ),
    actuators=("muscle", "chamber"),
)
