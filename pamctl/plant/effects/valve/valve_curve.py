"""The port's area is not proportional to the spool's travel."""

from __future__ import annotations

from math import copysign, pow
from typing import NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    EffectDescription,
    EffectEntry,
    EffectForm,
    size,
)
from pamctl.plant.effects.valve.valve_saturation import FULL_COMMAND_V


class ValveCurve(NamedTuple):
    """A quadratic part of the area, or a power law, which equals the linear area at 5 V."""

    curvature_per_v: float = 0.0
    exponent: float = 1.0


def apply_curve_v(curve: ValveCurve, opening_v: float) -> float:
    """Return the opening that a linear valve would need for the same area."""
    travel = abs(opening_v)
    bent_v = opening_v * (1.0 + curve.curvature_per_v * travel)
    if curve.exponent != 1.0 and travel > 0.0:
        bent_v *= pow(travel / FULL_COMMAND_V, curve.exponent - 1.0)
    return bent_v


def undo_curve_v(curve: ValveCurve, passed_v: float) -> float:
    """Return the travel at which the port has this area, by bisection.

    The area of a curve that bends down has a largest value: beyond it the travel stays there.
    """
    if passed_v == 0.0:
        return 0.0
    low_v, high_v = 0.0, 2.0 * FULL_COMMAND_V
    bend, power = curve.curvature_per_v, curve.exponent
    if bend < 0.0:
        high_v = min(high_v, -power / ((power + 1.0) * bend))
    for _ in range(60):
        middle_v = 0.5 * (low_v + high_v)
        if apply_curve_v(curve, middle_v) < abs(passed_v):
            low_v = middle_v
        else:
            high_v = middle_v
    return copysign(high_v, passed_v)


DESCRIPTION = EffectDescription(
    name="valve_curve",
    kind=ValveCurve,
    block="pressure",
    equation="A_v = K_Av u (1 + k_2 |u|) (|u| / 5 V)^(n - 1)",
    parameters=(
        size(
            "curvature_per_v",
            "1/V",
            0.2,
            smallest=0.006,
            start=0.02,
            meaning="k_2",
            low=-0.15,
        ),
        size(
            "exponent",
            "1",
            2.0,
            smallest=0.03,
            start=1.1,
            meaning="n",
            neutral=1.0,
            low=0.5,
        ),
    ),
    signature="the flow's error depends on the size of the command and not on its sign",
    best_experiment="null-staircase",
    seen_by=("pressure",),
    entries=(EffectEntry("opening", apply_curve_v, after=("valve_deadband",), undo=undo_curve_v),),
    forms=(
        EffectForm("quadratic", free=("curvature_per_v",)),
        EffectForm("power", free=("exponent",)),
    ),
    as_terms=(AsTerm("command", "curve", "command"), AsTerm("opening", "curve", "command")),
)
