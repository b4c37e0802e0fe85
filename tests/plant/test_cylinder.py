"""A cylinder behind a valve, against its equations written out for a general solver."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from support.cylinder import AIR_PA, Cylinder, LiftingMuscle, excite

from pamctl.plant.drive import build_grid, drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters, settings_of, values_of
from pamctl.plant.parameters import vented_state

PERIOD_S = 2e-3
T_S = np.arange(0.0, 2.5, PERIOD_S)


@pytest.mark.parametrize(
    "cylinder",
    [
        Cylinder(area_m2=2e-3, volume_m3=2e-4, stroke_m=0.4, mass_kg=8.0, gain_m2_per_v=2e-6),
        Cylinder(preload_n=60.0, stiffness_n_per_m=400.0),
    ],
    ids=["large", "soft spring"],
)
def test_piston_and_pressure_follow_the_equations_also_into_both_ends(cylinder: Cylinder) -> None:
    commands = excite(T_S)
    plant = plant_parameters(cylinder.plant())
    grid = build_grid(np.diff(T_S), len(T_S), 4)
    response = drive_coupled(plant, commands, grid)
    position_m, pressure_pa = cylinder.simulate(T_S, commands)
    assert position_m.min() < 1e-4 < 0.9 * cylinder.stroke_m < position_m.max()
    off_m = np.abs(response.position_m - np.clip(position_m, 0.0, cylinder.stroke_m))
    assert np.sqrt(np.mean(off_m**2)) < 2e-3 * cylinder.stroke_m  # its ends give way
    off_pa = response.pressure_pa - pressure_pa
    assert np.sqrt(np.mean(off_pa**2)) < 2e-3 * np.ptp(pressure_pa)


def test_a_muscle_lifts_a_load_off_the_floor_and_lays_it_down_again() -> None:
    muscle, commands = LiftingMuscle(), excite(T_S) - 1.0
    grid = build_grid(np.diff(T_S), len(T_S), 4)
    response = drive_coupled(plant_parameters(muscle.plant()), commands, grid)
    position_m, pressure_pa = muscle.simulate(T_S, commands)
    assert position_m[len(T_S) // 3 :].min() < 1e-4 < 0.02 < position_m.max()
    off_m = np.abs(response.position_m - np.maximum(position_m, 0.0))
    assert np.sqrt(np.mean(off_m**2)) < 2e-3 * np.ptp(position_m)  # its floor gives way
    off_pa = response.pressure_pa - pressure_pa
    assert np.sqrt(np.mean(off_pa**2)) < 2e-3 * np.ptp(pressure_pa)


@pytest.mark.parametrize("rig", [Cylinder(preload_n=60.0), LiftingMuscle()], ids=["piston", "load"])
def test_what_is_pressed_against_its_stop_rests_there(rig: Cylinder) -> None:
    rest = vented_state(plant_parameters(rig.plant()))
    assert (rest.position_m, rest.pressure_pa) == (0.0, AIR_PA)


@pytest.mark.parametrize("rig", [Cylinder(), LiftingMuscle()], ids=["cylinder", "muscle"])
def test_a_file_with_stops_goes_through_the_flat_numbers_and_back(rig: Cylinder) -> None:
    plant = rig.plant()
    assert settings_of(values_of(plant)) == plant


def test_a_muscle_without_a_spring_needs_what_carries_its_load() -> None:
    data = LiftingMuscle().plant().model_dump(exclude_none=True)
    del data["stroke_m"]
    with pytest.raises(ValidationError, match="without a spring, stroke_m says what carries"):
        PlantSettings.model_validate(data)


@pytest.mark.parametrize("missing", ["cylinder_area_m2", "cylinder_volume_m3", "stroke_m"])
def test_a_cylinder_without_its_geometry_is_refused_by_name(missing: str) -> None:
    data = Cylinder().plant().model_dump(exclude_none=True)
    del data[missing]
    with pytest.raises(ValidationError, match=f"`actuator: cylinder` needs {missing}"):
        PlantSettings.model_validate(data)
