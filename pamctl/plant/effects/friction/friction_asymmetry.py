"""Dry friction differs between the two directions of motion."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectEntry, size
from pamctl.plant.effects.places import FrictionBand


class FrictionAsymmetry(NamedTuple):
    """Relative difference of the dry friction from its mean."""

    share: float = 0.0


def tilt_band(asymmetry: FrictionAsymmetry, band: FrictionBand) -> FrictionBand:
    """Return the band with its two sides scaled apart."""
    return FrictionBand(
        band.lower_n * (1.0 - asymmetry.share), band.upper_n * (1.0 + asymmetry.share)
    )


DESCRIPTION = EffectDescription(
    name="friction_asymmetry",
    kind=FrictionAsymmetry,
    block="mechanics",
    equation="f in [-(1 - a) f_0, (1 + a) f_0]; if f_0 is constant, the same as a load a f_0",
    parameters=(
        size(
            "share",
            "1",
            0.95,
            smallest=0.02,
            start=0.1,
            meaning="a, positive where dry friction is greater while x grows",
            low=-0.95,
        ),
    ),
    signature="a constant load, unless dry friction changes with pressure or speed",
    best_experiment="",
    seen_by=("mechanics",),
    entries=(
        EffectEntry(
            "friction",
            tilt_band,
            after=("coulomb_friction", "pressure_friction", "return_friction", "stribeck"),
        ),
    ),
    actuators=("direct",),
)
