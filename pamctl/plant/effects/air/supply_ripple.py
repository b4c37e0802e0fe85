"""The supply's pressure swings: a compressor that starts and stops, a regulator that hunts."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi, sin
from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, shape, size

HIGHEST_HZ = 50.0


class SupplyRipple(NamedTuple):
    """A sine in the supply's pressure, from the plant's start on."""

    amplitude_pa: float = 0.0
    frequency_hz: float = 1.0
    phase_rad: float = 0.0


def ripple_pa(ripple: SupplyRipple, age_s: float) -> float:
    """Return what the ripple adds to the supply's pressure."""
    if ripple.amplitude_pa == 0.0:
        return 0.0
    return ripple.amplitude_pa * sin(2.0 * pi * ripple.frequency_hz * age_s + ripple.phase_rad)


def from_wave(term: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers of the ripple that is a wave of the supply in time."""
    turned = pi if term["size"] < 0.0 else 0.0
    phase = (term["phase"] + turned + pi) % (2.0 * pi) - pi
    return {
        "amplitude_pa": abs(term["size"]),
        "frequency_hz": 1.0 / term["inner"],
        "phase_rad": phase,
    }


DESCRIPTION = EffectDescription(
    name="supply_ripple",
    kind=SupplyRipple,
    block="pressure",
    equation="P_s = P_tank + a sin(2 pi f t + phi)",
    parameters=(
        size("amplitude_pa", "Pa", 100e3, smallest=1.7e3, start=5e3, meaning="a"),
        shape(
            "frequency_hz",
            "Hz",
            0.02,
            HIGHEST_HZ,
            usual=1.0,
            smallest=0.01,
            meaning="f",
        ),
        shape(
            "phase_rad",
            "rad",
            -2.0 * pi,
            2.0 * pi,
            usual=0.0,
            smallest=0.1,
            meaning="phi, at the start of a record",
        ),
    ),
    signature="an error while filling that comes and goes at a rhythm of its own",
    best_experiment="square-1",
    seen_by=("pressure",),
    woven=("air",),
    # A fit from a wrong frequency ends in a wrong valley: the terms' search finds the start.
    as_terms=(AsTerm("supply", "wave", "time", numbers=from_wave),),
)
