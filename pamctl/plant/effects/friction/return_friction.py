"""Kinetic friction also acts when the muscle lengthens; in the paper only when it contracts."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size
from pamctl.plant.effects.places import FrictionBand


class ReturnFriction(NamedTuple):
    """Share of the friction of contraction that acts when the muscle lengthens."""

    share: float = 0.0


def add_return_friction(friction: ReturnFriction, band: FrictionBand) -> FrictionBand:
    """Extend the band of Eq. 5 to the other direction."""
    return FrictionBand(band.lower_n - friction.share * band.upper_n, band.upper_n)


DESCRIPTION = EffectDescription(
    name="return_friction",
    kind=ReturnFriction,
    block="mechanics",
    equation="f in [-r f_c, f_c],  f_c = mu_k N P_g A_b b theta cos(theta)",
    parameters=(
        size(
            "share",
            "1",
            2.0,
            smallest=0.025,
            start=0.1,
            meaning="r, share of the friction when contracting",
        ),
    ),
    signature="an error only while the muscle lengthens, in proportion to pressure",
    best_experiment="slow-ramps",
    seen_by=("mechanics",),
    entries=(EffectEntry("friction", add_return_friction),),
    actuators=("muscle",),
    as_terms=(AsTerm("pull", "hysteresis", "position"),),
)
