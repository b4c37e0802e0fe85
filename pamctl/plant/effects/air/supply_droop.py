"""The supply's pressure falls while air is taken: a regulator with resistance, behind it a tank."""

from __future__ import annotations

from math import exp
from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectForm, shape, size

FAST = 0.1
"""Time of the second tank over that of the first."""


class SupplyDroop(NamedTuple):
    """A static droop without a refill time; otherwise a finite tank that the regulator fills.

    The tank's volume is refill_time R T / resistance.
    """

    resistance_pa_s_per_kg: float = 0.0
    refill_time_s: float = 0.0
    fast_share: float = 0.0
    """Share of the resistance in a second tank, at the valve, that refills ten times as fast."""


def kept_share(droop: SupplyDroop, step_s: float) -> float:
    """Return the share of a tank's present pressure that remains after `step_s` of refill."""
    return exp(-step_s / droop.refill_time_s) if droop.refill_time_s > 0.0 else 0.0


def kept_of_branch(droop: SupplyDroop, step_s: float) -> float:
    """Return the same share for the second, fast tank."""
    return exp(-step_s / (FAST * droop.refill_time_s)) if droop.refill_time_s > 0.0 else 0.0


def droop_resistance(droop: SupplyDroop, step_s: float) -> float:
    """Return by how much each kg/s lowers the supply after `step_s`, Pa s/kg."""
    slow = (1.0 - kept_share(droop, step_s)) * (1.0 - droop.fast_share)
    if droop.fast_share > 0.0:
        slow += (1.0 - kept_of_branch(droop, step_s)) * droop.fast_share
    return slow * droop.resistance_pa_s_per_kg


DESCRIPTION = EffectDescription(
    name="supply_droop",
    kind=SupplyDroop,
    block="pressure",
    equation="tau P_s' = P_tank - R_s m - P_s,  m = flow out of the supply; static for tau = 0; "
    "two tanks: a share of R_s with tau / 10",
    parameters=(
        size(
            "resistance_pa_s_per_kg",
            "Pa s/kg",
            5e7,
            smallest=1e6,
            start=5e6,
            meaning="R_s, resistance of the regulator and its tube",
        ),
        shape(
            "refill_time_s",
            "s",
            0.0,
            5.0,
            usual=0.0,
            smallest=5e-3,
            meaning="tau = V_t R_s / (R T) of a tank of volume V_t between regulator and valve",
        ),
        shape(
            "fast_share",
            "1",
            0.0,
            1.0,
            usual=0.0,
            smallest=0.1,
            meaning="share of R_s behind a second tank, with a tenth of tau",
        ),
    ),
    signature="an error while filling only, in proportion to the flow; a tank makes it last",
    best_experiment="square-1",
    seen_by=("pressure",),
    woven=("air",),
    forms=(
        EffectForm("static", free=("resistance_pa_s_per_kg",)),
        EffectForm(
            "finite tank",
            free=("resistance_pa_s_per_kg", "refill_time_s"),
            held={"refill_time_s": 0.05},
        ),
        EffectForm(
            "two tanks",
            free=("resistance_pa_s_per_kg", "refill_time_s", "fast_share"),
            held={"refill_time_s": 0.1, "fast_share": 0.4},
        ),
    ),
    as_terms=(AsTerm("supply", "curve", "time"),),
)
