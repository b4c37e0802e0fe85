"""The return spring, or the bladder, hardens or softens with stroke."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size


class CubicStiffness(NamedTuple):
    """Cubic part of the restoring force."""

    n_per_m3: float = 0.0


def cubic_force_n(cubic: CubicStiffness, position_m: float) -> float:
    """Return the pull; it opposes the displacement."""
    return -(cubic.n_per_m3 * position_m * position_m * position_m)


DESCRIPTION = EffectDescription(
    name="cubic_stiffness",
    kind=CubicStiffness,
    block="mechanics",
    equation="-k x - k_3 x^3",
    parameters=(size("n_per_m3", "N/m3", 1e7, smallest=2e5, start=1e6, meaning="k_3", low=-1e7),),
    signature="a static error, a function of the displacement only",
    best_experiment="fill-and-hold",
    seen_by=("mechanics",),
    entries=(EffectEntry("force", cubic_force_n),),
    as_terms=(AsTerm("force", "curve", "position"), AsTerm("force", "beyond", "position")),
)
