"""Dry friction grows with pressure, in both directions: a seal that the air presses on."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectEntry, size
from pamctl.plant.effects.places import FrictionBand


class PressureFriction(NamedTuple):
    """Dry friction per gauge pressure."""

    n_per_pa: float = 0.0


def add_pressed_friction(
    pressed: PressureFriction, band: FrictionBand, gauge_pa: float
) -> FrictionBand:
    """Widen the band on both sides; by nothing below atmospheric pressure."""
    force_n = pressed.n_per_pa * max(gauge_pa, 0.0)
    return FrictionBand(band.lower_n - force_n, band.upper_n + force_n)


DESCRIPTION = EffectDescription(
    name="pressure_friction",
    kind=PressureFriction,
    block="mechanics",
    equation="f in [-(f_0 + f_1 P_g), f_0 + f_1 P_g]",
    parameters=(
        size(
            "n_per_pa",
            "N/Pa",
            4e-4,
            smallest=1e-6,
            start=1e-5,
            meaning="f_1, dry friction per gauge pressure",
        ),
    ),
    signature="an error with the sign of the speed, in proportion to pressure",
    best_experiment="",
    seen_by=("mechanics",),
    entries=(EffectEntry("friction", add_pressed_friction, after=("return_friction",)),),
    actuators=("direct",),
)
