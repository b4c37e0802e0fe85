"""A load moves with the muscle. On the paper's it hardly shows: M / c is 88 us, below a tick."""

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


def explain_settling(numbers: PaperParameters) -> str:
    """Say how fast the velocity settles: a mass shows in no slower motion."""
    settling_s = numbers.mass_kg / numbers.damping_n_s_per_m
    return (
        f"velocity settles within M / c = {1e3 * settling_s:.2g} ms, and a mass shows in faster "
        "motion only: weigh what moves"
    )


DESCRIPTION = EffectDescription(
    name="moving_mass",
    kind=MovingMass,
    block="mechanics",
    equation="(M + m) x''",
    parameters=(size("added_kg", "kg", 2.0, smallest=0.03, start=0.2, meaning="m"),),
    signature="with a light load nothing above the noise: velocity settles within M / c",
    best_experiment="",
    seen_by=("mechanics",),
    entries=(EffectEntry("numbers", add_mass),),
    unidentifiable=explain_settling,
    actuators=("muscle",),
)
