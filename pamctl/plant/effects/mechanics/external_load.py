"""A weight or a spring under tension pulls the muscle out."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class ExternalLoad(NamedTuple):
    """Constant force against contraction."""

    force_n: float = 0.0


DESCRIPTION = EffectDescription(
    name="external_load",
    block="mechanics",
    equation="F - F_e",
    parameters=(
        size(
            "force_n",
            "N",
            20.0,
            smallest=0.5,
            start=3.0,
            meaning="F_e, against contraction",
            low=-20.0,
        ),
    ),
    signature="a constant static offset; gone if the encoder is homed at the loaded rest",
    best_experiment="fill-and-hold",
    parts=("mechanics",),
    seen_by=("mechanics",),
)
