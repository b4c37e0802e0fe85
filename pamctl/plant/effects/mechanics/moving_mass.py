"""A load moves with the muscle. It cannot be identified here: M / c is 88 us, below a tick."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectEntry, size

if TYPE_CHECKING:
    from pamctl.plant.parameters import PaperParameters


class MovingMass(NamedTuple):
    """Mass added to M."""

    added_kg: float = 0.0


def add_mass(mass: MovingMass, numbers: PaperParameters) -> PaperParameters:
    """Return the plant's numbers with the total mass."""
    return numbers._replace(mass_kg=numbers.mass_kg + mass.added_kg)


DESCRIPTION = EffectDescription(
    name="moving_mass",
    kind=MovingMass,
    block="mechanics",
    equation="(M + m) x''",
    parameters=(size("added_kg", "kg", 2.0, smallest=0.03, start=0.2, meaning="m"),),
    signature="nothing above the noise: velocity settles within M / c = 88 us, a tenth of a sample",
    best_experiment="",
    seen_by=("mechanics",),
    entries=(EffectEntry("numbers", add_mass),),
    unidentifiable="it acts within 0.1 ms, a tenth of a sample: no experiment at 1 kHz shows it",
    actuators=("muscle",),
)
