"""Viscous friction grows with pressure, in both directions."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size


class PressureDamping(NamedTuple):
    """Damping per gauge pressure, added to c."""

    per_pa: float = 0.0


def pressure_damping_n_s_per_m(damping: PressureDamping, gauge_pa: float) -> float:
    """Return the damping added to c; 0 below atmospheric pressure."""
    return damping.per_pa * max(gauge_pa, 0.0)


DESCRIPTION = EffectDescription(
    name="pressure_damping",
    kind=PressureDamping,
    block="mechanics",
    equation="c = c_0 + c_p P_g",
    parameters=(size("per_pa", "N s/(m Pa)", 2e-3, smallest=5e-5, start=2e-4, meaning="c_p"),),
    signature="an error in proportion to speed times pressure",
    best_experiment="square-1",
    seen_by=("mechanics",),
    entries=(EffectEntry("damping", pressure_damping_n_s_per_m),),
    as_terms=(AsTerm("damping", "gain", "pressure"), AsTerm("damping", "curve", "pressure")),
)
