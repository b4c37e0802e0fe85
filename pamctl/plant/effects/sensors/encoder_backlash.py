"""Play between the muscle's end and the encoder's scale."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size
from pamctl.plant.effects.play import follow_with_play


class EncoderBacklash(NamedTuple):
    """Width of the play."""

    width_m: float = 0.0


def follow_backlash_m(backlash: EncoderBacklash, before_m: float, position_m: float) -> float:
    """Follow the muscle with a slack of `width_m` in all."""
    return follow_with_play(before_m, position_m, backlash.width_m)


DESCRIPTION = EffectDescription(
    name="encoder_backlash",
    block="sensors",
    equation="play operator: x - w/2 <= x_m <= x + w/2, x_m moves only when pushed",
    parameters=(
        size("width_m", "m", 1e-3, smallest=12e-6, start=50e-6, meaning="w, width of the play"),
    ),
    signature="a flat spot of one width at every reversal, whatever the pressure",
    best_experiment="multisine-small",
    parts=("sensors",),
    seen_by=("mechanics",),
)
