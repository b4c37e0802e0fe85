"""A piston of constant area, on which the measured pressure acts."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectEntry, size


class Piston(NamedTuple):
    """Area of the piston."""

    area_m2: float = 0.0


def piston_force_n(piston: Piston, gauge_pa: float) -> float:
    """Return the push; it acts towards growing displacement where the area is positive."""
    return piston.area_m2 * gauge_pa


DESCRIPTION = EffectDescription(
    name="piston",
    kind=Piston,
    block="mechanics",
    equation="A (P - P_atm), added to the force",
    parameters=(
        size(
            "area_m2",
            "m2",
            1e-3,
            smallest=1e-6,
            start=3e-5,
            meaning="A; negative where pressure pushes towards smaller x",
            low=-1e-3,
        ),
    ),
    signature="an error in proportion to pressure, at any position and speed",
    best_experiment="",
    seen_by=("mechanics",),
    entries=(EffectEntry("force", piston_force_n),),
    actuators=("direct",),
)
