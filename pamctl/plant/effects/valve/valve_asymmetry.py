"""The exhaust port is wider or narrower than the filling one."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class ValveAsymmetry(NamedTuple):
    """Gain of the exhaust, over that of filling."""

    exhaust_gain: float = 1.0


def apply_asymmetry_v(asymmetry: ValveAsymmetry, opening_v: float) -> float:
    """Return the opening that a symmetric valve would need for the same area."""
    return opening_v if opening_v > 0.0 else asymmetry.exhaust_gain * opening_v


DESCRIPTION = EffectDescription(
    name="valve_asymmetry",
    block="pressure",
    equation="A_v = a K_Av u for u < 0",
    parameters=(
        size(
            "exhaust_gain",
            "1",
            2.0,
            smallest=0.03,
            start=0.9,
            meaning="gain for u < 0 over that for u > 0",
            neutral=1.0,
            low=0.4,
        ),
    ),
    signature="filling is right and exhausting wrong by a constant factor of the flow",
    best_experiment="null-staircase",
    parts=("valve",),
    seen_by=("pressure",),
)
