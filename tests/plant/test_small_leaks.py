"""A leak that grows from nothing: the plant follows it smoothly, wherever motion takes it."""

from __future__ import annotations

import numpy as np
import pytest

from pamctl.plant.drive import build_grid, drive_coupled, drive_pressure
from pamctl.plant.model import PlantSettings, values_of
from pamctl.plant.parameters import parameters_of

PLANT = values_of(PlantSettings())
AREAS_M2 = (1e-14, 1e-12, 1e-10)


def pressure_of(leak: str, area_m2: float) -> np.ndarray:
    """Return the pressure at slow commands of a few tens of millivolts, which motion outruns."""
    at_s = np.arange(6000) * 1e-3
    commands = 0.4 * np.sin(2.0 * np.pi * 0.9 * at_s) + 0.1
    grid = build_grid(np.full(len(at_s) - 1, 1e-3), len(at_s), 4)
    plant = parameters_of({**PLANT, f"{leak}.area_m2": area_m2})
    return drive_coupled(plant, commands, grid).pressure_pa


@pytest.mark.parametrize("leak", ["valve_leak", "chamber_leak"])
def test_a_leak_changes_the_pressure_in_proportion_to_its_area(leak: str) -> None:
    none = pressure_of(leak, 0.0)
    change = {area: float(np.abs(pressure_of(leak, area) - none).max()) for area in AREAS_M2}
    assert change[1e-14] < 30.0
    assert change[1e-10] < 200.0


def test_a_leaking_valve_does_not_hold_the_pressure_of_air_that_is_pressed() -> None:
    """A chamber is pressed together by a third with the valve closed: P V^k is kept."""
    at_s = np.arange(2000) * 1e-3
    grid = build_grid(np.full(len(at_s) - 1, 1e-3), len(at_s), 4)
    commands = np.where(at_s < 0.05, 5.0, 0.0)
    moved_m = np.where(at_s < 1.0, 0.04, 0.04 - 0.03 * np.minimum(at_s - 1.0, 0.5) / 0.5)
    plant, leaking = (parameters_of({**PLANT, "valve_leak.area_m2": area}) for area in (0.0, 1e-13))
    tight, leaky = (
        drive_pressure(p, commands, moved_m, grid).pressure_pa for p in (plant, leaking)
    )
    assert np.ptp(tight[1000:]) > 20e3
    assert np.abs(leaky - tight).max() < 30.0
