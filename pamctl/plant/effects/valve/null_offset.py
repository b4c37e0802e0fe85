"""The valve does not close at zero command: its spool, or its driver, has an offset."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size


class NullOffset(NamedTuple):
    """What the valve adds to its command."""

    offset_v: float = 0.0


def add_offset_v(null: NullOffset, command_v: float) -> float:
    """Return the command that the spool gets."""
    return command_v + null.offset_v


def remove_offset_v(null: NullOffset, passed_v: float) -> float:
    """Return the command at which the spool gets `passed_v`."""
    return passed_v - null.offset_v


DESCRIPTION = EffectDescription(
    name="null_offset",
    kind=NullOffset,
    block="pressure",
    equation="A_v = K_Av (u + u_0)",
    parameters=(
        size(
            "offset_v",
            "V",
            1.0,
            smallest=0.02,
            start=0.1,
            meaning="u_0; above 0 the valve fills at zero command",
            low=-1.0,
        ),
    ),
    signature="at zero command the measured pressure moves one way; commands near null fill too "
    "much and exhaust too little, or the other way round",
    best_experiment="null-staircase",
    seen_by=("pressure",),
    entries=(EffectEntry("command", add_offset_v, undo=remove_offset_v),),
    # `diagnose` asks it as a question of the set-up, before any effect.
    as_terms=(AsTerm("command", "constant", numbers=lambda term: {"offset_v": term["size"]}),),
)
