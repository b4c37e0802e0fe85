"""A weight or a spring under tension pulls the muscle out."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size


class ExternalLoad(NamedTuple):
    """Constant force against contraction."""

    force_n: float = 0.0


def load_force_n(load: ExternalLoad) -> float:
    """Return the pull; it opposes contraction."""
    return -load.force_n


DESCRIPTION = EffectDescription(
    name="external_load",
    kind=ExternalLoad,
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
    signature="a constant static offset; it vanishes if the encoder is homed under the load",
    best_experiment="fill-and-hold",
    seen_by=("mechanics",),
    entries=(EffectEntry("force", load_force_n),),
    actuators=("muscle",),
    as_terms=(AsTerm("force", "constant"),),
)
