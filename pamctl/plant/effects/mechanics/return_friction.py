"""Kinetic friction acts on the way back, too; the paper has it when contracting only."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class ReturnFriction(NamedTuple):
    """Share of the contracting friction that acts when the muscle lengthens."""

    share: float = 0.0


DESCRIPTION = EffectDescription(
    name="return_friction",
    block="mechanics",
    equation="f in [-r f_c, f_c],  f_c = mu_k N P_g A_b b theta cos(theta)",
    parameters=(
        size(
            "share",
            "1",
            2.0,
            smallest=0.025,
            start=0.1,
            meaning="r, of the friction when contracting",
        ),
    ),
    signature="only while the muscle lengthens, in proportion to pressure",
    best_experiment="square",
    parts=("mechanics",),
    seen_by=("mechanics",),
)
