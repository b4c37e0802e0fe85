"""Half the steps of the simulation, where a difference or a comparison is all that is asked.

Of two simulations with equal steps, the integrator's error hardly shows in the difference. With
one step in a millisecond, derivatives are right to 2 % (most to 0.1 %), and a comparison of models
to a hundredth of a sensor's noise in pressure, a ninth in position.
"""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.fitting.numbers import FreeNumber, look_up_parameter
from pamctl.plant.model import PlantSettings, values_of

STEPS_IN_TIME = 4.0
"""A time constant of fewer steps needs the fine ones: a spool of 1 ms would be half wrong."""


def coarsen(
    drives: Sequence[Drive], *plants: PlantSettings, free: Sequence[FreeNumber] = ()
) -> tuple[Drive, ...]:
    """Return the drives with half the steps; as they are, if a plant has a short time constant.

    Times among the numbers `free` may become short.
    """
    if any(_is_time(number.name) for number in free):
        return tuple(drives)
    times_s = [
        value
        for plant in plants
        for name, value in values_of(plant).items()
        if value > 0.0 and _is_time(name)
    ]
    return tuple(d if _is_too_coarse(d, times_s) else d.coarse for d in drives)


def _is_too_coarse(drive: Drive, times_s: Sequence[float]) -> bool:
    longest_s = float(drive.coarse.grid.step_s.max(initial=0.0))
    return min(times_s, default=longest_s * STEPS_IN_TIME) < STEPS_IN_TIME * longest_s


def _is_time(name: str) -> bool:
    return "." in name and look_up_parameter(name).unit == "s"
