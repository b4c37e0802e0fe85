"""The spool's lands overlap the ports: near null the valve does not open."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    EffectDescription,
    EffectEntry,
    EffectForm,
    size,
)


class ValveDeadband(NamedTuple):
    """Overlap on each side of null, at least 0."""

    fill_width_v: float = 0.0
    exhaust_width_v: float = 0.0


def apply_deadband_v(deadband: ValveDeadband, opening_v: float) -> float:
    """Return the spool's travel minus the overlap."""
    if opening_v > 0.0:
        return max(opening_v - deadband.fill_width_v, 0.0)
    return min(opening_v + deadband.exhaust_width_v, 0.0)


def undo_deadband_v(deadband: ValveDeadband, passed_v: float) -> float:
    """Return the travel that leaves this opening beyond the overlap; 0 for a closed valve."""
    if passed_v > 0.0:
        return passed_v + deadband.fill_width_v
    return passed_v - deadband.exhaust_width_v if passed_v < 0.0 else 0.0


DESCRIPTION = EffectDescription(
    name="valve_deadband",
    kind=ValveDeadband,
    block="pressure",
    equation="A_v = K_Av (u - d_f) for u > d_f, K_Av (u + d_e) for u < -d_e, else 0",
    parameters=(
        size("fill_width_v", "V", 1.5, smallest=0.02, start=0.1, meaning="dead band where u > 0"),
        size(
            "exhaust_width_v", "V", 1.5, smallest=0.02, start=0.1, meaning="dead band where u < 0"
        ),
    ),
    signature="with commands within some three widths of null the simulated pressure drifts and "
    "the measured one stays; full-scale squares show only a loss of gain",
    best_experiment="null-staircase",
    seen_by=("pressure",),
    entries=(EffectEntry("opening", apply_deadband_v, undo=undo_deadband_v),),
    forms=(
        EffectForm("two sides", free=("fill_width_v", "exhaust_width_v")),
        EffectForm("filling only", free=("fill_width_v",)),
        EffectForm("exhausting only", free=("exhaust_width_v",)),
    ),
    as_terms=(AsTerm("command", "dead_zone", "command"), AsTerm("command", "curve", "command")),
)
