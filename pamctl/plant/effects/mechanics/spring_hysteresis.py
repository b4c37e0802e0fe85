"""Loading and unloading differ at any speed: rubber, a cable, a spring that rubs on itself."""

from __future__ import annotations

from math import exp
from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    EffectDescription,
    EffectEntry,
    EffectMemory,
    shape,
    size,
)


class SpringHysteresis(NamedTuple):
    """Bouc and Wen's force, with one number for the way back."""

    force_n: float = 0.0
    way_m: float = 1e-3


class Loop(NamedTuple):
    """Where the spring is in its loop: -1 unloading, 1 loading."""

    state: float


def start_loop(position_m: float, pressure_pa: float) -> Loop:
    """Return a spring that was never loaded."""
    return Loop(0.0)


def follow_loop(spring: SpringHysteresis, memory: Loop, begin_m: float, end_m: float) -> Loop:
    """Advance the loop over a motion in one direction, exactly."""
    if end_m == begin_m:
        return memory
    limit = 1.0 if end_m > begin_m else -1.0
    return Loop(limit + (memory.state - limit) * exp(-abs(end_m - begin_m) / spring.way_m))


def loop_force_n(spring: SpringHysteresis, memory: Loop) -> float:
    """Return the pull of the loop: against the motion that made it."""
    return -spring.force_n * memory.state


DESCRIPTION = EffectDescription(
    name="spring_hysteresis",
    kind=SpringHysteresis,
    block="mechanics",
    equation="-k x - f z,  dz = (sign(dx) - z) |dx| / w",
    parameters=(
        size(
            "force_n",
            "N",
            20.0,
            smallest=0.3,
            start=1.0,
            meaning="f, half the force between loading and unloading",
        ),
        shape(
            "way_m",
            "m",
            1e-5,
            20e-3,
            usual=1e-3,
            smallest=1e-4,
            meaning="w, the way over which the loop closes after a reversal",
        ),
    ),
    signature="after every reversal the motion lags by a force that builds up over a way, at any "
    "speed and also without pressure",
    best_experiment="slow-ramps",
    seen_by=("mechanics",),
    entries=(EffectEntry("force", loop_force_n, memory=EffectMemory(start_loop, follow_loop)),),
    actuators=("muscle", "direct"),
    as_terms=(
        AsTerm(
            "force",
            "hysteresis",
            "position",
            numbers=lambda term: {"force_n": -term["size"], "way_m": term["inner"]},
        ),
    ),
)
