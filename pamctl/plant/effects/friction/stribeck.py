"""Dry friction is greater at rest and at low speed."""

from __future__ import annotations

from math import exp, pow
from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    Distinction,
    EffectDescription,
    EffectEntry,
    EffectForm,
    shape,
    size,
)
from pamctl.plant.effects.places import FrictionBand


class Stribeck(NamedTuple):
    """Rise of the friction band towards zero speed."""

    rise: float = 0.0
    speed_m_per_s: float = 5e-3
    exponent: float = 2.0
    """2 is Gaussian, 1 Tustin's exponential."""


def stribeck_factor(stribeck: Stribeck, velocity_m_per_s: float) -> float:
    """Return the ratio of dry friction to that at high speed."""
    if stribeck.rise == 0.0:
        return 1.0
    share = abs(velocity_m_per_s) / stribeck.speed_m_per_s
    return 1.0 + stribeck.rise * exp(-pow(share, stribeck.exponent))


def scale_band(stribeck: Stribeck, band: FrictionBand, velocity_m_per_s: float) -> FrictionBand:
    """Return the band at a speed."""
    factor = stribeck_factor(stribeck, velocity_m_per_s)
    return FrictionBand(factor * band.lower_n, factor * band.upper_n)


DESCRIPTION = EffectDescription(
    name="stribeck",
    kind=Stribeck,
    block="mechanics",
    equation="f_lim (1 + s exp(-(|v| / v_s)^n))",
    parameters=(
        size("rise", "1", 1.5, smallest=0.04, start=0.2, meaning="s, rise at rest"),
        shape(
            "speed_m_per_s",
            "m/s",
            5e-4,
            0.1,
            usual=5e-3,
            smallest=1e-3,
            meaning="v_s, speed at which the rise has fallen to a third",
        ),
        shape(
            "exponent",
            "1",
            0.5,
            2.0,
            usual=2.0,
            smallest=0.5,
            meaning="n: 2 Gaussian, 1 Tustin's",
        ),
    ),
    signature="a late break-away that overshoots, and an error at low speed",
    best_experiment="multisine-small",
    seen_by=("mechanics",),
    entries=(
        EffectEntry(
            "friction",
            scale_band,
            after=("coulomb_friction", "pressure_friction", "return_friction"),
        ),
    ),
    forms=(
        EffectForm("Gaussian", ("rise", "speed_m_per_s"), {"exponent": 2.0}),
        EffectForm("Tustin", ("rise", "speed_m_per_s"), {"exponent": 1.0}),
    ),
    told_from={
        "return_friction": Distinction(
            "slow-ramps",
            "return friction grows with pressure, while the muscle lengthens only; this one grows "
            "at low speed, in both directions",
        ),
    },
    as_terms=(AsTerm("braid_friction", "curve", "velocity"),),
)
