"""Dry friction that does not depend on pressure: seal, bushing, guide, encoder."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class CoulombFriction(NamedTuple):
    """The same force against either direction."""

    force_n: float = 0.0


DESCRIPTION = EffectDescription(
    name="coulomb_friction",
    block="mechanics",
    equation="f in [-f_0, f_0], added to the band of Eq. 5",
    parameters=(size("force_n", "N", 40.0, smallest=0.3, start=2.0, meaning="f_0"),),
    signature="both ways, without pressure as well: the vented muscle rests off its zero",
    best_experiment="square",
    parts=("mechanics",),
    seen_by=("mechanics",),
)
