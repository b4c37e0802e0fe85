"""A tube between valve and muscle, with resistance and volume; the sensor is at its valve end.

The pressure at the sensor therefore leads the pressure in the muscle.
"""

from __future__ import annotations

from math import exp, sqrt
from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectForm, shape, size


class LineRestriction(NamedTuple):
    """Laminar and turbulent resistance of the tube, and its volume, lumped at the valve."""

    resistance_pa_s_per_kg: float = 0.0
    volume_m3: float = 0.0
    turbulent_pa_s2_per_kg2: float = 0.0
    """Pressure drop over the square of the flow, in air of atmospheric pressure."""


def restricts(line: LineRestriction) -> bool:
    """Tell whether the pressures at the two ends of the line differ."""
    return line.resistance_pa_s_per_kg > 0.0 or line.turbulent_pa_s2_per_kg2 > 0.0


def line_drop_pa(
    line: LineRestriction, flow_kg_per_s: float, end_pa: float, atmosphere_pa: float
) -> float:
    """Return by how much the valve's end is above the end at `end_pa`, for a flow into it.

    A turbulent isothermal flow in a pipe of constant friction loses P_1^2 - P^2 = 2 P_atm R_t g|g|.
    """
    drop_pa = line.resistance_pa_s_per_kg * flow_kg_per_s
    if line.turbulent_pa_s2_per_kg2 > 0.0:
        lost = 2.0 * atmosphere_pa * line.turbulent_pa_s2_per_kg2
        squared = end_pa * end_pa + lost * flow_kg_per_s * abs(flow_kg_per_s)
        drop_pa += sqrt(max(squared, 0.0)) - end_pa
    return drop_pa


def resistance_at_drop(
    line: LineRestriction, drop_pa: float, end_pa: float, atmosphere_pa: float
) -> float:
    """Return the drop over the flow, Pa s/kg, where the ends of the line differ by `drop_pa`."""
    if line.turbulent_pa_s2_per_kg2 <= 0.0:
        return line.resistance_pa_s_per_kg
    half = 0.5 * line.resistance_pa_s_per_kg
    middle_pa = max(end_pa + 0.5 * drop_pa, 1.0)
    turbulent = line.turbulent_pa_s2_per_kg2 * atmosphere_pa / middle_pa
    return half + sqrt(half * half + turbulent * abs(drop_pa))


def line_time_s(line: LineRestriction, specific_energy_j_per_kg: float) -> float:
    """Return the time constant of the line's own volume behind its laminar resistance."""
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
    equation="V_l P_1' = R T (m - g),  (P V)' = R T g,  the sensor sees P_1;  g = (P_1 - P) / R_l, "
    "or P_1 - P = R_l g + R_t g|g| P_atm / P_m",
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
            meaning="V_l, volume at the valve's end; it is filled through R_l alone",
        ),
        size(
            "turbulent_pa_s2_per_kg2",
            "Pa s2/kg2",
            2e11,
            smallest=3e9,
            start=1.5e10,
            meaning="R_t, turbulent resistance at atmospheric pressure; P_m is the mean pressure",
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
        EffectForm(
            "turbulent",
            free=("resistance_pa_s_per_kg", "turbulent_pa_s2_per_kg2"),
            held={"volume_m3": 0.0},
        ),
    ),
    actuators=("muscle", "chamber"),
)
