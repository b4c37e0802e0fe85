"""The spool moves at a limited rate: its driver's current or its spring is at the limit."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    EffectDescription,
    EffectEntry,
    EffectMemory,
    size,
)


class ValveSlew(NamedTuple):
    """The time that the spool takes for a volt of command; 0 is a spool without a limit."""

    slowness_s_per_v: float = 0.0


class MovingSpool(NamedTuple):
    """Where the spool is on its way to the command."""

    spool_v: float


def start_slew(position_m: float, pressure_pa: float) -> MovingSpool:
    """Return a spool at null."""
    return MovingSpool(0.0)


def follow_slew_v(slew: ValveSlew, memory: MovingSpool, end: float, step_s: float) -> MovingSpool:
    """Move towards the command by at most `step_s` over the slowness."""
    way_v = step_s / slew.slowness_s_per_v
    return MovingSpool(memory.spool_v + min(max(end - memory.spool_v, -way_v), way_v))


def give_moving_spool_v(slew: ValveSlew, memory: MovingSpool) -> float:
    """Return the spool's position (V)."""
    return memory.spool_v


DESCRIPTION = EffectDescription(
    name="valve_slew",
    kind=ValveSlew,
    block="pressure",
    equation="|s'| <= 1 / r, s goes to u",
    parameters=(
        size(
            "slowness_s_per_v",
            "s/V",
            20e-3,
            smallest=1e-4,
            start=5e-4,
            meaning="r, time that the spool takes for a volt",
        ),
    ),
    signature="an error in the first milliseconds after a step of the command; it grows with the "
    "height of the step, and small commands do not show it",
    best_experiment="chirp",
    seen_by=("pressure",),
    entries=(
        EffectEntry(
            "command",
            give_moving_spool_v,
            memory=EffectMemory(start_slew, follow_slew_v),
            after=("valve_saturation", "valve_hysteresis"),
        ),
    ),
    as_terms=(
        AsTerm(
            "command",
            "slew",
            "command",
            numbers=lambda term: {"slowness_s_per_v": 1.0 / term["inner"]},
        ),
    ),
)
