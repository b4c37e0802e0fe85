"""Play between the muscle's end and the encoder's scale."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectEntry, EffectMemory, size
from pamctl.plant.effects.play import follow_with_play

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


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


def undo_backlash_m(
    backlash: EncoderBacklash, shown_m: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return about where the muscle's end is behind the readings.

    A play of the same width is behind the reading what the reading is behind the muscle. So it is
    on either side after half a width; within the play nobody knows, and it goes there gradually.
    """
    from pamctl.kernel.calls import machine

    true_m = shown_m.copy()
    machine(add_slack)(backlash.width_m, true_m)
    return true_m


def add_slack(width_m: float, position_m: Array) -> None:
    """Add to each position by how much a play of its own is behind it."""
    carrier_m = position_m[0]
    for k in range(len(position_m)):
        carrier_m = follow_with_play(carrier_m, position_m[k], width_m)
        position_m[k] += position_m[k] - carrier_m


def restart_behind_play(
    backlash: EncoderBacklash,
    carrier: ScaleCarrier,
    position_m: float,
    velocity_m_per_s: float,
    shown_m: float,
    shown_m_per_s: float,
) -> tuple[float, float, ScaleCarrier]:
    """Return position, velocity and scale behind a measured reading and its rate.

    A reading that moves is pushed: its rate tells the side of the play. One that rests says nothing
    of the motion within the play, which goes on as it was simulated.
    """
    if shown_m_per_s == 0.0:
        slack_m = position_m - carrier.position_m
        return shown_m + slack_m, velocity_m_per_s, ScaleCarrier(shown_m)
    side = 0.5 if shown_m_per_s > 0.0 else -0.5
    return shown_m + side * backlash.width_m, shown_m_per_s, ScaleCarrier(shown_m)


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
    seen_by=("pressure", "mechanics"),
    entries=(
        EffectEntry(
            "position_reading",
            show_carrier_m,
            memory=EffectMemory(start_carrier, follow_backlash_m),
            undo=undo_backlash_m,
        ),
    ),
)
