"""What changes over minutes: temperature, wear, a supply that runs down."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    EffectDescription,
    EffectEntry,
    EffectForm,
    size,
)

LEAST_FACTOR = 0.1
"""A drifting number keeps at least this share of its first value."""


class Drift(NamedTuple):
    """Relative trends since the plant's start, in 1/s."""

    valve_gain_per_s: float = 0.0
    stiffness_per_s: float = 0.0
    friction_per_s: float = 0.0


def drift_factor(per_s: float, age_s: float) -> float:
    """Return the factor by which a number has changed."""
    return max(1.0 + per_s * age_s, LEAST_FACTOR) if per_s != 0.0 else 1.0


def apply_gain_drift_v(drift: Drift, opening_v: float, age_s: float) -> float:
    """Return the opening that a valve without drift would need for the same area."""
    return drift_factor(drift.valve_gain_per_s, age_s) * opening_v


DESCRIPTION = EffectDescription(
    name="drift",
    kind=Drift,
    block="pressure",
    equation="K_Av (1 + r_v t),  k (1 + r_k t),  mu_k (1 + r_f t)",
    parameters=(
        size(
            "valve_gain_per_s",
            "1/s",
            0.01,
            smallest=2e-4,
            start=5e-4,
            meaning="r_v, trend of the valve's gain",
            low=-0.01,
        ),
        size(
            "stiffness_per_s",
            "1/s",
            0.01,
            smallest=1e-4,
            start=5e-4,
            meaning="r_k, trend of the stiffness",
            low=-0.01,
        ),
        size(
            "friction_per_s",
            "1/s",
            0.01,
            smallest=2e-4,
            start=5e-4,
            meaning="r_f, trend of the kinetic friction",
            low=-0.01,
        ),
    ),
    signature="parameters fitted to successive parts of a record show a trend in time",
    best_experiment="squares-apart",
    seen_by=("pressure", "mechanics"),
    entries=(EffectEntry("opening", apply_gain_drift_v, after=("valve_asymmetry",)),),
    woven=("mechanics",),
    forms=(
        EffectForm("valve gain", free=("valve_gain_per_s",)),
        EffectForm("stiffness", free=("stiffness_per_s",)),
        EffectForm("friction", free=("friction_per_s",)),
    ),
    as_terms=(
        AsTerm("filling", "gain", "time"),
        AsTerm("exhausting", "gain", "time"),
        AsTerm("opening", "gain", "time"),
        AsTerm("stiffness", "gain", "time"),
        AsTerm("braid_friction", "gain", "time"),
    ),
)
