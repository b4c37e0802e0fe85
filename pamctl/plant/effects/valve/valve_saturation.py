"""The spool reaches its stop, or the driver its limit, before the command does."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size

FULL_COMMAND_V = 5.0


class ValveSaturation(NamedTuple):
    """How far below the full command of 5 V the opening stops growing."""

    shortfall_v: float = 0.0


def saturate_command_v(saturation: ValveSaturation, command_v: float) -> float:
    """Return the command that the driver passes on."""
    if saturation.shortfall_v <= 0.0:
        return command_v
    limit_v = FULL_COMMAND_V - saturation.shortfall_v
    return min(max(command_v, -limit_v), limit_v)


DESCRIPTION = EffectDescription(
    name="valve_saturation",
    kind=ValveSaturation,
    block="pressure",
    equation="u limited to +-(5 V - d)",
    parameters=(
        size(
            "shortfall_v",
            "V",
            4.0,
            smallest=0.2,
            start=0.5,
            meaning="by how much the limit is below the full command of 5 V",
        ),
    ),
    signature="at large commands only, in both directions, the measured flow is smaller",
    best_experiment="null-staircase",
    seen_by=("pressure",),
    entries=(
        # Within its limit the driver passes the command on; more command does no more.
        EffectEntry("command", saturate_command_v, after=("null_offset",), undo=saturate_command_v),
    ),
    as_terms=(AsTerm("command", "saturation", "command"),),
)
