"""The exhaust port is wider or narrower than the filling one."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    Distinction,
    EffectDescription,
    EffectEntry,
    size,
)


class ValveAsymmetry(NamedTuple):
    """Ratio of the exhaust gain to the filling gain."""

    exhaust_gain: float = 1.0


def apply_asymmetry_v(asymmetry: ValveAsymmetry, opening_v: float) -> float:
    """Return the opening that a symmetric valve would need for the same area."""
    return opening_v if opening_v > 0.0 else asymmetry.exhaust_gain * opening_v


def undo_asymmetry_v(asymmetry: ValveAsymmetry, passed_v: float) -> float:
    """Return the opening of the wider or narrower port that has this area."""
    return passed_v if passed_v > 0.0 else passed_v / asymmetry.exhaust_gain


DESCRIPTION = EffectDescription(
    name="valve_asymmetry",
    kind=ValveAsymmetry,
    block="pressure",
    equation="A_v = a K_Av u for u < 0",
    parameters=(
        size(
            "exhaust_gain",
            "1",
            2.0,
            smallest=0.03,
            start=0.9,
            meaning="ratio of the gain for u < 0 to that for u > 0",
            neutral=1.0,
            low=0.4,
        ),
    ),
    signature="filling is right; the flow of exhausting is wrong by a constant factor",
    best_experiment="null-staircase",
    seen_by=("pressure",),
    entries=(
        EffectEntry("opening", apply_asymmetry_v, after=("valve_curve",), undo=undo_asymmetry_v),
    ),
    told_from={
        "valve_deadband": Distinction("null-staircase", "a dead band acts near null only"),
        "supply_droop": Distinction(
            "square-1", "a droop grows with the flow, an asymmetry does not"
        ),
    },
    as_terms=(AsTerm("filling", "constant"), AsTerm("exhausting", "constant")),
)
