"""Half the steps of the simulation, where a difference or a comparison is all that is asked.

Of two simulations with equal steps, the integrator's error hardly shows in the difference. With
one step in a millisecond, derivatives are right to 2 % (most to 0.1 %), and a comparison of models
to a hundredth of a sensor's noise in pressure, a ninth in position.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.fitting.numbers import FreeNumber, look_up_parameter
from pamctl.plant.model import PlantSettings, values_of

STEPS_IN_TIME = 4.0
"""A time constant of fewer steps needs the fine ones: a spool of 1 ms would be half wrong."""


def coarsen(
    drives: Sequence[Drive], *plants: PlantSettings, free: Sequence[FreeNumber] = ()
) -> tuple[Drive, ...]:
    """Return the drives with half the steps; as they are, if a plant needs all of them.

    Short time constants do, and friction that falls with speed. Numbers that are `free` may
    become so.
    """
    if any(_unit_of(number.name) in ("s", "m/s") for number in free):
        return tuple(drives)
    acting = [
        (value, _unit_of(name))
        for plant in plants
        for name, value in values_of(plant).items()
        if value > 0.0
    ]
    if any(unit == "m/s" for _, unit in acting):
        return tuple(drives)
    shortest_s = min((value for value, unit in acting if unit == "s"), default=math.inf)
    if math.isinf(shortest_s):
        return tuple(d.coarse for d in drives)
    return tuple(d if _is_too_coarse(d, shortest_s) else d.coarse for d in drives)


def _is_too_coarse(drive: Drive, shortest_s: float) -> bool:
    longest_s = float(drive.coarse.grid.step_s.max(initial=0.0))
    return shortest_s < STEPS_IN_TIME * longest_s


def _unit_of(name: str) -> str:
    return look_up_parameter(name).unit if "." in name else ""
