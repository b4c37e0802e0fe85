"""Play between the muscle's end and the encoder's scale."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectEntry, EffectMemory, size
from pamctl.plant.effects.play import follow_with_play


class EncoderBacklash(NamedTuple):
    """Width of the play."""

    width_m: float = 0.0


class ScaleCarrier(NamedTuple):
    """Where the muscle has pushed the encoder's scale."""

    position_m: float


def start_carrier(position_m: float, pressure_pa: float) -> ScaleCarrier:
    """Return a scale in the middle of its play."""
    return ScaleCarrier(position_m)


def follow_backlash_m(backlash: EncoderBacklash, memory: ScaleCarrier, end: float) -> ScaleCarrier:
    """Follow the muscle with a total slack of `width_m`."""
    return ScaleCarrier(follow_with_play(memory.position_m, end, backlash.width_m))


def show_carrier_m(backlash: EncoderBacklash, memory: ScaleCarrier) -> float:
    """Return the displacement that the encoder reads."""
    return memory.position_m


DESCRIPTION = EffectDescription(
    name="encoder_backlash",
    kind=EncoderBacklash,
    block="sensors",
    equation="play operator: x - w/2 <= x_m <= x + w/2, x_m moves only when pushed",
    parameters=(
        size("width_m", "m", 1e-3, smallest=12e-6, start=50e-6, meaning="w, width of the play"),
    ),
    signature="a flat spot of constant width at every reversal, at any pressure",
    best_experiment="chirp",
    seen_by=("mechanics",),
    entries=(
        EffectEntry(
            "position_reading",
            show_carrier_m,
            memory=EffectMemory(start_carrier, follow_backlash_m),
        ),
    ),
)
