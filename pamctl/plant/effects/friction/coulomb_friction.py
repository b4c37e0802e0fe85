"""Dry friction that does not depend on pressure: seal, bushing, guide, encoder."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size
from pamctl.plant.effects.places import FrictionBand


class CoulombFriction(NamedTuple):
    """A constant force against motion in either direction."""

    force_n: float = 0.0


def add_dry_friction(coulomb: CoulombFriction, band: FrictionBand) -> FrictionBand:
    """Widen the band on both sides."""
    return FrictionBand(band.lower_n - coulomb.force_n, band.upper_n + coulomb.force_n)


DESCRIPTION = EffectDescription(
    name="coulomb_friction",
    kind=CoulombFriction,
    block="mechanics",
    equation="f in [-f_0, f_0], added to the band of Eq. 5",
    parameters=(size("force_n", "N", 40.0, smallest=0.3, start=2.0, meaning="f_0"),),
    signature="in both directions, also without pressure: what moves comes to rest off its zero",
    best_experiment="slow-ramps",
    seen_by=("mechanics",),
    entries=(EffectEntry("friction", add_dry_friction, after=("return_friction",)),),
    as_terms=(AsTerm("force", "hysteresis", "position"),),
)
