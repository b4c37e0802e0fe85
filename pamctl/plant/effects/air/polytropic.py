"""The air's temperature follows compression and flow: between isothermal and adiabatic.

With a time of the walls the air takes their temperature again: a fast change is adiabatic, a slow
one isothermal, and the pressure creeps after a fast one although no air flows. The walls take heat
in proportion to the difference of temperature, whatever the volume: while a muscle contracts, its
volume may double, and its surface, b^2 sin(2 theta) / (2 n), hardly changes.
"""

from __future__ import annotations

from math import exp, pow, sqrt
from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectForm, shape, size

THINNEST = 1e-3
"""Less air than this share of that at rest has the walls' temperature at once."""
COLDEST, HOTTEST = 0.3, 3.0
"""Limits of T / T_0."""


class Polytropic(NamedTuple):
    """Exponent of the change of state: 1 is isothermal, as in Eq. 7, 1.4 adiabatic."""

    exponent: float = 1.0
    wall_time_s: float = 0.0
    """Time in which the air of a vented muscle takes the walls' temperature; 0: it never does."""


class HeatShares(NamedTuple):
    """What the walls leave of the air's excess temperature in a step."""

    kept: float
    """Of that at the step's start, after the step."""
    caused: float
    """Of that which arises evenly during the step, at its end."""


def heat_shares(polytropic: Polytropic, mass: float, step_s: float) -> HeatShares:
    """Return the shares for this mass of air, over that of a vented muscle at rest.

    The time of the walls must be above 0.
    """
    if mass < THINNEST:  # a search may ask for what no rig does
        return HeatShares(0.0, 0.0)
    times = polytropic.wall_time_s * mass / step_s
    kept = exp(-1.0 / times)
    return HeatShares(kept, times * (1.0 - kept))


def polytropic_volume(exponent: float, volume_m3: float) -> float:
    """Return V^a; inflow adds to P V^a."""
    return volume_m3 if exponent == 1.0 else pow(volume_m3, exponent)


def polytropic_slope(exponent: float, volume_m3: float) -> float:
    """Return a V^(a-1), the slope of V^a."""
    return 1.0 if exponent == 1.0 else exponent * pow(volume_m3, exponent - 1.0)


def outflow_energy(warmth: float) -> float:
    """Return what air of T / T_0 carries away through an orifice, over that of air of T_0.

    The mass falls with the root of the temperature, and each kilogram carries R T.
    """
    return sqrt(warmth)


DESCRIPTION = EffectDescription(
    name="polytropic",
    kind=Polytropic,
    block="pressure",
    equation="d(P V^a)/dt = a R T m V^(a-1); with walls T' also has -(T - T_0) / tau, "
    "tau = wall_time m / m_rest",
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
            has_natural_end=True,
        ),
        shape(
            "wall_time_s",
            "s",
            0.0,
            100.0,
            usual=0.0,
            smallest=0.02,
            meaning="time in which the air of a vented muscle takes the walls' heat; 0: never",
        ),
    ),
    signature="the rate of pressure is wrong by one factor, under flow and under motion; with "
    "walls the pressure creeps after each fast change",
    best_experiment="square-1",
    seen_by=("pressure",),
    woven=("air",),
    forms=(
        EffectForm("one exponent", free=("exponent",)),
        EffectForm(
            "near walls",
            free=("exponent", "wall_time_s"),
            held={"exponent": 1.35, "wall_time_s": 0.02},
        ),
        EffectForm(
            "far walls",
            free=("exponent", "wall_time_s"),
            held={"exponent": 1.35, "wall_time_s": 0.5},
        ),
    ),
)
