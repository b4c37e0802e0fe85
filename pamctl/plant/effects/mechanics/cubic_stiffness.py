"""The return spring, or the bladder, hardens or softens with stroke."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class CubicStiffness(NamedTuple):
    """Cubic part of the restoring force."""

    n_per_m3: float = 0.0


DESCRIPTION = EffectDescription(
    name="cubic_stiffness",
    block="mechanics",
    equation="-k x - k_3 x^3",
    parameters=(size("n_per_m3", "N/m3", 1e7, smallest=2e5, start=1e6, meaning="k_3", low=-1e7),),
    signature="static, a function of the displacement only",
    best_experiment="fill-and-hold",
    parts=("mechanics",),
    seen_by=("mechanics",),
)
