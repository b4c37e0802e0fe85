"""Play or stiction of the spool: it follows its command with a slack."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size
from pamctl.plant.effects.play import follow_with_play


class ValveHysteresis(NamedTuple):
    """Slack between command and spool."""

    width_v: float = 0.0


def follow_hysteresis_v(hysteresis: ValveHysteresis, before_v: float, command_v: float) -> float:
    """Follow the command with a slack of `width_v` in all."""
    return follow_with_play(before_v, command_v, hysteresis.width_v)


DESCRIPTION = EffectDescription(
    name="valve_hysteresis",
    block="pressure",
    equation="play operator: u - w/2 <= s <= u + w/2, s moves only when pushed",
    parameters=(
        size("width_v", "V", 0.5, smallest=0.02, start=0.1, meaning="w, width of the slack"),
    ),
    signature="the opening depends on where the command came from; small commands only",
    best_experiment="null-staircase",
    parts=("valve",),
    seen_by=("pressure",),
)
