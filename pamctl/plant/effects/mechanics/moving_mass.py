"""A load moves along. It cannot be identified here: M / c is 88 us, below a tick."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class MovingMass(NamedTuple):
    """Mass added to M."""

    added_kg: float = 0.0


def total_mass_kg(mass: MovingMass, mass_kg: float) -> float:
    """Return the whole mass; part of the plant's parameters, not of its steps."""
    return mass_kg + mass.added_kg


DESCRIPTION = EffectDescription(
    name="moving_mass",
    block="mechanics",
    equation="(M + m) x''",
    parameters=(size("added_kg", "kg", 2.0, smallest=0.03, start=0.2, meaning="m"),),
    signature="none above the noise: velocity settles within M / c = 88 us, long before a sample",
    best_experiment="none",
    parts=(),
    seen_by=("mechanics",),
    identifiable=False,
)
