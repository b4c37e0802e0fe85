"""The command reaches the valve late: converters, driver, bus.

The delay re-times the stream of commands before it comes to the valve; a step of the plant
knows nothing of it. It is exact: a step is cut where a command arrives, so that a fit sees no
grid and a fraction of a tick counts as what it is.
"""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import Distinction, EffectDescription, size


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
    signature="in the first milliseconds after every change of the command; a phase lag that grows "
    "in proportion to frequency",
    best_experiment="chirp",
    seen_by=("pressure",),
    woven=("timing",),
    told_from={
        "valve_spool": Distinction(
            "chirp", "a lag of second order and a pure delay part at high frequency only"
        ),
    },
)
