"""Constant air volume beside the muscle: tubes, fittings, the sensor's port."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size


class DeadVolume(NamedTuple):
    """Constant volume that is filled and emptied with the muscle."""

    volume_m3: float = 0.0


def add_dead_volume_m3(dead: DeadVolume, volume_m3: float) -> float:
    """Return the total volume."""
    return volume_m3 + dead.volume_m3


DESCRIPTION = EffectDescription(
    name="dead_volume",
    kind=DeadVolume,
    block="pressure",
    equation="V = V(x) + V_d",
    parameters=(
        size("volume_m3", "m3", 6e-5, smallest=1e-6, start=4e-6, meaning="V_d, added volume"),
    ),
    signature="the simulated pressure changes too fast, most where the volume is smallest",
    best_experiment="slow-ramps",
    seen_by=("pressure",),
    entries=(EffectEntry("volume", add_dead_volume_m3),),
    as_terms=(AsTerm("volume", "constant"),),
)
