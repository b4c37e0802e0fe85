"""The ends of the muscle are not cylindrical: a part of its length takes no part."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class EndCap(NamedTuple):
    """Length that neither fills nor pulls."""

    length_m: float = 0.0


def active_length_m(cap: EndCap, rest_length_m: float) -> float:
    """Return what is left of L_0; part of the plant's parameters, not of its steps."""
    return rest_length_m - cap.length_m


DESCRIPTION = EffectDescription(
    name="end_cap",
    block="mechanics",
    equation="L = L_0 - l_e - x in V(x), A(x) and theta",
    parameters=(
        size("length_m", "m", 0.02, smallest=1e-3, start=3e-3, meaning="l_e, lost length"),
    ),
    signature="static, a function of the displacement times pressure",
    best_experiment="fill-and-hold",
    parts=(),
    seen_by=("mechanics", "pressure"),
)
