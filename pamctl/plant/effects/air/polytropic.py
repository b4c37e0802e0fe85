"""The air's temperature follows compression and flow: between isothermal and adiabatic."""

from __future__ import annotations

from math import pow
from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class Polytropic(NamedTuple):
    """Exponent of the change of state: 1 is isothermal, as in Eq. 7, 1.4 adiabatic."""

    exponent: float = 1.0


def polytropic_volume(polytropic: Polytropic, volume_m3: float) -> float:
    """Return V^a; inflow adds to P V^a."""
    return volume_m3 if polytropic.exponent == 1.0 else pow(volume_m3, polytropic.exponent)


def polytropic_slope(polytropic: Polytropic, volume_m3: float) -> float:
    """Return a V^(a-1), the slope of V^a."""
    if polytropic.exponent == 1.0:
        return 1.0
    return polytropic.exponent * pow(volume_m3, polytropic.exponent - 1.0)


DESCRIPTION = EffectDescription(
    name="polytropic",
    kind=Polytropic,
    block="pressure",
    equation="d(P V^a)/dt = a R T m V^(a-1)",
    parameters=(
        size(
            "exponent",
            "1",
            1.4,
            smallest=0.03,
            start=1.1,
            meaning="a: 1 isothermal, 1.4 adiabatic",
            neutral=1.0,
            low=1.0,
        ),
    ),
    signature="the rate of pressure is wrong by one factor, under flow and under motion",
    best_experiment="square-1",
    seen_by=("pressure",),
    woven=("air",),
)
