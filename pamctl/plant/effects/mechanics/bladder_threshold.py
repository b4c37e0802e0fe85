"""The bladder must stretch before it loads the braid."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size


class BladderThreshold(NamedTuple):
    """Gauge pressure that is lost to the bladder."""

    pressure_pa: float = 0.0


def reduce_pulling_pa(bladder: BladderThreshold, pulling_pa: float) -> float:
    """Return the gauge pressure that pulls."""
    if bladder.pressure_pa == 0.0:
        return pulling_pa
    return max(pulling_pa - bladder.pressure_pa, 0.0)


DESCRIPTION = EffectDescription(
    name="bladder_threshold",
    kind=BladderThreshold,
    block="mechanics",
    equation="F = max(P_g - P_th, 0) A(x)",
    parameters=(size("pressure_pa", "Pa", 6e4, smallest=1e3, start=5e3, meaning="P_th"),),
    signature="the stroke begins late at the vented end; above, a constant loss of pressure",
    best_experiment="square-1",
    seen_by=("mechanics",),
    entries=(EffectEntry("pulling_pressure", reduce_pulling_pa),),
    actuators=("muscle",),
    as_terms=(AsTerm("pressing", "constant"), AsTerm("pressing", "curve", "pressure")),
)
