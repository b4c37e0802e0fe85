"""Viscous friction differs between the two directions of motion."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class ViscousAsymmetry(NamedTuple):
    """Relative difference of the damping from its mean."""

    share: float = 0.0


DESCRIPTION = EffectDescription(
    name="viscous_asymmetry",
    kind=ViscousAsymmetry,
    block="mechanics",
    equation="c (1 + a) while x grows, c (1 - a) while it falls",
    parameters=(
        size(
            "share",
            "1",
            0.95,
            smallest=0.02,
            start=0.1,
            meaning="a, positive where the damping is greater while x grows",
            low=-0.95,
        ),
    ),
    signature="an error in proportion to the absolute value of the speed",
    best_experiment="",
    seen_by=("mechanics",),
    woven=("mechanics",),
    actuators=("direct",),
)
