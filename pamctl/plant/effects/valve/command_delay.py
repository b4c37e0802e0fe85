"""The command reaches the valve late: converters, driver, bus.

The delay shifts the commands in time before they reach the valve; a step of the plant does not
contain it. It is exact: a step is cut where a command arrives, so a fit can resolve a fraction of
a tick.
"""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, Distinction, EffectDescription, size


class CommandDelay(NamedTuple):
    """Time from writing a command to its effect at the valve's driver."""

    delay_s: float = 0.0


DESCRIPTION = EffectDescription(
    name="command_delay",
    kind=CommandDelay,
    block="pressure",
    equation="u(t - tau)",
    parameters=(
        size(
            "delay_s", "s", 20e-3, smallest=2e-4, start=1e-3, meaning="tau, any fraction of a tick"
        ),
    ),
    signature="an error in the first milliseconds after every change of the command; a phase lag "
    "in proportion to frequency",
    best_experiment="chirp",
    seen_by=("pressure",),
    woven=("timing",),
    told_from={
        "valve_spool": Distinction(
            "chirp", "a lag of second order and a pure delay differ at high frequency only"
        ),
    },
    as_terms=(AsTerm("command", "lag", "command"),),
)
