"""The braid's threads are elastic: pressure makes them longer."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, size


class BraidStretch(NamedTuple):
    """Strain of the threads per gauge pressure."""

    compliance_per_pa: float = 0.0


def stretch_ratio(braid: BraidStretch, gauge_pa: float) -> float:
    """Return the ratio of the threads' length to their length without pressure."""
    return 1.0 + braid.compliance_per_pa * gauge_pa


DESCRIPTION = EffectDescription(
    name="braid_stretch",
    kind=BraidStretch,
    block="mechanics",
    equation="b = b_0 (1 + e P_g) in V(x) and A(x)",
    parameters=(
        size(
            "compliance_per_pa",
            "1/Pa",
            2e-7,
            smallest=1e-8,
            start=3e-8,
            meaning="e, strain per gauge pressure",
        ),
    ),
    signature="a static error in the square of the pressure; similar to a change of k and b",
    best_experiment="fill-and-hold",
    seen_by=("mechanics", "pressure"),
    woven=(
        "air",
        "mechanics",
    ),
    actuators=("muscle",),
    as_terms=(AsTerm("pull", "gain", "pressure"),),
)
