"""Air leaks past the spool's lands: from the tank to the muscle, and from there to the room."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectForm, shape, size


class ValveLeak(NamedTuple):
    """Two equal leaks at null; they shrink as the spool moves."""

    area_m2: float = 0.0
    fade_per_v: float = 0.0


def leak_area_m2(leak: ValveLeak, spool_v: float) -> float:
    """Return the area of each of the two leaks."""
    return leak.area_m2 / (1.0 + leak.fade_per_v * abs(spool_v))


DESCRIPTION = EffectDescription(
    name="valve_leak",
    kind=ValveLeak,
    block="pressure",
    equation="m += A (Psi(P_tank, P) - Psi(P, P_atm)),  A = A_l / (1 + k |u|)",
    parameters=(
        size("area_m2", "m2", 3e-7, smallest=1e-9, start=1e-8, meaning="A_l, area of each leak"),
        shape(
            "fade_per_v",
            "1/V",
            0.0,
            5.0,
            usual=0.0,
            smallest=0.2,
            meaning="k, fading of the leak as the spool leaves null",
        ),
    ),
    signature="with the valve closed the pressure drifts to a value between tank and atmosphere; "
    "filling and exhausting do not reach their end pressures",
    best_experiment="fill-and-hold",
    seen_by=("pressure",),
    woven=("air",),
    forms=(
        EffectForm("everywhere", free=("area_m2",)),
        EffectForm("at null", free=("area_m2", "fade_per_v"), held={"fade_per_v": 0.5}),
    ),
    as_terms=(AsTerm("flow", "curve", "pressure"),),
)
