"""Air leaks out of the muscle into the room."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, Distinction, EffectDescription, size


class ChamberLeak(NamedTuple):
    """A hole in the muscle or its fittings."""

    area_m2: float = 0.0


DESCRIPTION = EffectDescription(
    name="chamber_leak",
    kind=ChamberLeak,
    block="pressure",
    equation="m -= A_c Psi(P, P_atm)",
    parameters=(
        size("area_m2", "m2", 3e-7, smallest=1e-9, start=1e-8, meaning="A_c, area of the leak"),
    ),
    signature="with the valve closed the pressure falls towards atmospheric pressure, faster at "
    "higher pressure",
    best_experiment="fill-and-hold",
    seen_by=("pressure",),
    woven=("air",),
    told_from={
        "valve_leak": Distinction(
            "fill-and-hold",
            "with the valve closed a valve leak ends between tank and atmosphere, a chamber leak "
            "at atmospheric pressure",
        ),
    },
    as_terms=(AsTerm("flow", "gain", "pressure"), AsTerm("flow", "curve", "pressure")),
)
