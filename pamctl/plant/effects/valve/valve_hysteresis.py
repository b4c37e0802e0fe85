"""Play or stiction of the spool: it follows its command with a slack."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    EffectDescription,
    EffectEntry,
    EffectMemory,
    size,
)
from pamctl.plant.effects.play import follow_with_play


class ValveHysteresis(NamedTuple):
    """Slack between command and spool."""

    width_v: float = 0.0


class PushedSpool(NamedTuple):
    """Where the command has pushed the spool."""

    spool_v: float


def start_hysteresis(position_m: float, pressure_pa: float) -> PushedSpool:
    """Return a spool at null."""
    return PushedSpool(0.0)


def follow_hysteresis_v(
    hysteresis: ValveHysteresis, memory: PushedSpool, end: float
) -> PushedSpool:
    """Follow the command with a total slack of `width_v`."""
    return PushedSpool(follow_with_play(memory.spool_v, end, hysteresis.width_v))


def give_spool_v(hysteresis: ValveHysteresis, memory: PushedSpool) -> float:
    """Return the spool's position (V)."""
    return memory.spool_v


DESCRIPTION = EffectDescription(
    name="valve_hysteresis",
    kind=ValveHysteresis,
    block="pressure",
    equation="play operator: u - w/2 <= s <= u + w/2, s moves only when pushed",
    parameters=(
        size("width_v", "V", 0.5, smallest=0.02, start=0.1, meaning="w, width of the slack"),
    ),
    signature="the opening depends on the previous commands; visible with small commands only",
    best_experiment="null-staircase",
    seen_by=("pressure",),
    entries=(
        EffectEntry(
            "command",
            give_spool_v,
            memory=EffectMemory(start_hysteresis, follow_hysteresis_v),
            after=("valve_saturation",),
        ),
    ),
    as_terms=(AsTerm("command", "play", "command"),),
)
