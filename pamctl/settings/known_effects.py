"""From `compensate: [...]` and a plant file to the numbers with which the tick undoes effects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from pamctl.base.texts import hint_at_nearest
from pamctl.control.around_the_law import Compensation, limit_slope, list_wanted_v
from pamctl.control.law import LawSettings
from pamctl.plant.catalogue import CATALOGUE, Effects, undo_reading, undo_valve_v
from pamctl.plant.effects.description import acts
from pamctl.plant.model import PlantSettings, plant_parameters, values_of
from pamctl.settings.rig_file import RigFile

STEEPEST = 3.0
"""Highest slope of the compensated command, in volts a volt.

The exact inverse of a dead band jumps at null, that of a power law rises without bound.
"""
_GAUGE_PROBES_PA = (0.0, 1e5, 4e5)
_POSITION_PROBES_M = (0.0, 5e-3, 20e-3)
"""Readings at which an inverse is looked at."""


class _Line(NamedTuple):
    """Corrected = scale * shown + offset."""

    scale: float
    offset: float


def build_compensation(
    plant: PlantSettings, rig: RigFile, controller: LawSettings
) -> Compensation | None:
    """Return what rig file and gains file ask to undo; None where they ask for nothing.

    Raises ValueError for an effect that no tick can undo, or that the plant file does not have.
    """
    names = tuple(dict.fromkeys((*rig.compensate, *controller.compensate)))
    if not names:
        return None
    _require_known(names, plant)
    parameters = plant_parameters(plant)
    effects, atmosphere_pa = parameters.effects, parameters.paper.atmospheric_pressure_pa
    reach_v = min(rig.limits.command_v, controller.command_limit_v)
    gauge = _find_line(effects, "pressure_reading", names, atmosphere_pa)
    if rig.homing.enabled:  # it takes the sensor's zero at the vented muscle, offset included
        gauge = gauge._replace(offset=atmosphere_pa * (1.0 - gauge.scale))
    position = _find_line(effects, "position_reading", names, atmosphere_pa)
    return Compensation(
        *position,
        *gauge,
        reach_v,
        _tabulate_side(effects, names, reach_v, rig.limits.command_v),
        _tabulate_side(effects, names, -reach_v, rig.limits.command_v),
    )


def list_undoable() -> list[str]:
    """Name the effects of the catalogue that a tick can undo."""
    return [name for name, effect in CATALOGUE.items() if effect.is_undoable]


def _require_known(names: Sequence[str], plant: PlantSettings) -> None:
    undoable, values = list_undoable(), values_of(plant)
    for name in names:
        if name not in CATALOGUE:
            hint = hint_at_nearest(name, undoable)
            raise ValueError(f"compensate: no effect is called {name}{hint}")
        if name not in undoable:
            raise ValueError(
                f"compensate: {name} cannot be undone within a tick; these can: "
                f"{', '.join(undoable)}. retune for it with `pamctl tune`"
            )
        parameters = CATALOGUE[name].parameters
        if not acts(
            CATALOGUE[name],
            {p.name: values.get(f"{name}.{p.name}", p.neutral) for p in parameters},
        ):
            raise ValueError(
                f"compensate: the plant file does not have {name}; give --plant a file with its "
                "numbers, as `pamctl diagnose` writes it"
            )


def _tabulate_side(
    effects: Effects, names: Sequence[str], reach_v: float, limit_v: float
) -> tuple[float, ...]:
    """Return the commands of one side of null; the side of `reach_v`'s sign."""
    commands = [undo_valve_v(effects.valve, names, wanted) for wanted in list_wanted_v(reach_v)]
    side = math.copysign(1.0, reach_v)
    rises = [side * (b - a) for a, b in pairwise(commands)]
    if not all(math.isfinite(v) for v in commands) or min(rises) < -1e-9:
        raise ValueError(
            f"compensate: {', '.join(names)}: with the numbers of the plant file more command does "
            "not always open the valve further, so the valve's map has no inverse"
        )
    held = [min(max(v, -limit_v), limit_v) for v in commands]
    return limit_slope(held, reach_v, STEEPEST)


def _find_line(effects: Effects, place: str, names: Sequence[str], atmosphere_pa: float) -> _Line:
    """Return the line that undoes the effects on a reading."""
    import numpy as np  # settings load without it

    if place == "pressure_reading":
        shown = atmosphere_pa + np.array(_GAUGE_PROBES_PA)
    else:
        shown = np.array(_POSITION_PROBES_M)
    times_s = np.zeros(len(shown))
    first, middle, last = undo_reading(
        place, effects.sensors, shown, times_s, atmosphere_pa, names
    ).tolist()
    scale = (last - first) / float(shown[2] - shown[0])
    expected = first + scale * float(shown[1] - shown[0])
    if not abs(middle - expected) <= 1e-9 * abs(last - first):
        raise ValueError(
            f"compensate: the inverse of {', '.join(names)} on the {place.replace('_', ' ')} is "
            "no straight line, which a tick cannot use"
        )
    return _Line(scale, first - scale * float(shown[0]))
