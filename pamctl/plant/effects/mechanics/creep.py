"""The bladder creeps: after a step the muscle keeps moving for seconds."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.air.line_restriction import lag_weights
from pamctl.plant.effects.description import (
    AsTerm,
    EffectDescription,
    EffectEntry,
    EffectForm,
    EffectMemory,
    shape,
    size,
)

FAST = 0.1
"""Time constant of the fast branch over that of the slow one: the two look like a logarithm."""


class Creep(NamedTuple):
    """A spring and a dashpot parallel to the muscle, or two such branches."""

    stiffness_n_per_m: float = 0.0
    time_constant_s: float = 1.0
    fast_share: float = 0.0
    """Share of the stiffness in a second branch, which is ten times as fast."""


class DashpotPositions(NamedTuple):
    """Positions of the dashpots."""

    slow_m: float
    fast_m: float


def start_dashpots(position_m: float, pressure_pa: float) -> DashpotPositions:
    """Return relaxed dashpots."""
    return DashpotPositions(position_m, position_m)


def advance_dashpots(
    creep: Creep, memory: DashpotPositions, begin_m: float, end_m: float, step_s: float
) -> DashpotPositions:
    """Advance the dashpots over a motion of constant speed, exactly."""
    kept, weight = lag_weights(creep.time_constant_s, step_s)
    slow_m = kept * memory.slow_m + (1.0 - kept) * begin_m + weight * (end_m - begin_m)
    if creep.fast_share == 0.0:
        return DashpotPositions(slow_m, slow_m)
    kept, weight = lag_weights(FAST * creep.time_constant_s, step_s)
    fast_m = kept * memory.fast_m + (1.0 - kept) * begin_m + weight * (end_m - begin_m)
    return DashpotPositions(slow_m, fast_m)


def creep_force_n(creep: Creep, memory: DashpotPositions, position_m: float) -> float:
    """Return the pull of the branches."""
    slow_n = creep.stiffness_n_per_m * (1.0 - creep.fast_share) * (position_m - memory.slow_m)
    fast_n = creep.stiffness_n_per_m * creep.fast_share * (position_m - memory.fast_m)
    return -(slow_n + fast_n)


DESCRIPTION = EffectDescription(
    name="creep",
    kind=Creep,
    block="mechanics",
    equation="-k x - k_c (x - z),  tau z' = x - z; two branches: a share of k_c with tau / 10",
    parameters=(
        size(
            "stiffness_n_per_m",
            "N/m",
            6000.0,
            smallest=50.0,
            start=300.0,
            meaning="k_c, stiffness that relaxes",
        ),
        shape(
            "time_constant_s",
            "s",
            0.05,
            30.0,
            usual=1.0,
            smallest=0.1,
            meaning="tau of the dashpot",
        ),
        shape(
            "fast_share",
            "1",
            0.0,
            1.0,
            usual=0.0,
            smallest=0.1,
            meaning="share of k_c with a tenth of tau",
        ),
    ),
    signature="slow drift at rest after every step, in the direction of the step",
    best_experiment="long-holds",
    seen_by=("mechanics",),
    entries=(
        EffectEntry("force", creep_force_n, memory=EffectMemory(start_dashpots, advance_dashpots)),
    ),
    forms=(
        EffectForm("one branch", ("stiffness_n_per_m", "time_constant_s")),
        EffectForm(
            "two branches",
            ("stiffness_n_per_m", "time_constant_s", "fast_share"),
            {"fast_share": 0.4},
        ),
    ),
    as_terms=(AsTerm("force", "lag", "position"),),
)
