"""The braid's friction changes along the stroke: its threads are worn, or sit tighter, there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, size


class PositionFriction(NamedTuple):
    """How mu_k changes with the displacement."""

    share_per_m: float = 0.0


def position_factor(friction: PositionFriction, position_m: float) -> float:
    """Return the factor on the braid's friction at a displacement; never below 0."""
    return max(1.0 + friction.share_per_m * position_m, 0.0)


def from_gain(term: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers of a gain, whose size is for 10 mm."""
    return {"share_per_m": 100.0 * term["size"]}


def from_curve(term: Mapping[str, float]) -> dict[str, float]:
    """Return the slope between a curve's ends, beside the share at no displacement."""
    ends = (term["size"] * term["knot_1"], term["size"] * term["knot_5"])
    slope = (ends[1] - ends[0]) / (term["high"] - term["low"])
    return {"share_per_m": slope / max(1.0 + ends[0] - slope * term["low"], 0.1)}


DESCRIPTION = EffectDescription(
    name="position_friction",
    kind=PositionFriction,
    block="mechanics",
    equation="mu_k (1 + r x) in place of mu_k in Eq. 5",
    parameters=(
        size(
            "share_per_m",
            "1/m",
            500.0,
            smallest=5.0,
            start=20.0,
            meaning="r",
            low=-45.0,
        ),
    ),
    signature="the friction band widens, or narrows, along the stroke",
    best_experiment="slow-ramps",
    seen_by=("mechanics",),
    woven=("mechanics",),
    actuators=("muscle",),
    as_terms=(
        AsTerm("braid_friction", "gain", "position", numbers=from_gain),
        AsTerm("braid_friction", "curve", "position", numbers=from_curve),
    ),
)
