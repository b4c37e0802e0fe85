"""Viscous friction grows with pressure on both ways."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class PressureDamping(NamedTuple):
    """Damping per gauge pressure, added to c."""

    per_pa: float = 0.0


DESCRIPTION = EffectDescription(
    name="pressure_damping",
    block="mechanics",
    equation="c = c_0 + c_p P_g",
    parameters=(size("per_pa", "N s/(m Pa)", 2e-3, smallest=5e-5, start=2e-4, meaning="c_p"),),
    signature="an error with speed times pressure",
    best_experiment="square",
    parts=("mechanics",),
    seen_by=("mechanics",),
)
