"""A cylinder behind a valve, its spool and its leaks, against equations written out."""

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.linalg import expm
from support.cylinder import AIR_PA, Cylinder, LiftingMuscle, excite

from pamctl.plant.drive import drive_coupled, drive_pressure
from pamctl.plant.effects.valve import ValveSpool, spool_step
from pamctl.plant.model import PlantSettings, plant_parameters, settings_of, values_of
from pamctl.plant.parameters import parameters_of, vented_state
from pamctl.plant.sample_grid import build_grid

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
def test_piston_and_pressure_follow_the_equations_also_into_both_ends(cylinder):
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


def test_a_muscle_lifts_a_load_off_the_floor_and_lays_it_down_again():
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
def test_what_is_pressed_against_its_stop_rests_there(rig):
    rest = vented_state(plant_parameters(rig.plant()))
    assert (rest.position_m, rest.pressure_pa) == (0.0, AIR_PA)


@pytest.mark.parametrize("rig", [Cylinder(), LiftingMuscle()], ids=["cylinder", "muscle"])
def test_a_file_with_stops_goes_through_the_flat_numbers_and_back(rig):
    plant = rig.plant()
    assert settings_of(values_of(plant)) == plant


def test_a_muscle_without_a_spring_needs_what_carries_its_load():
    data = LiftingMuscle().plant().model_dump(exclude_none=True)
    del data["stroke_m"]
    with pytest.raises(ValidationError, match="without a spring, stroke_m says what carries"):
        PlantSettings.model_validate(data)


@pytest.mark.parametrize("missing", ["cylinder_area_m2", "cylinder_volume_m3", "stroke_m"])
def test_a_cylinder_without_its_geometry_is_refused_by_name(missing):
    data = Cylinder().plant().model_dump(exclude_none=True)
    del data[missing]
    with pytest.raises(ValidationError, match=f"`actuator: cylinder` needs {missing}"):
        PlantSettings.model_validate(data)


# --- leaks that grow from nothing ----------------------------------------------------------------

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
def test_a_leak_changes_the_pressure_in_proportion_to_its_area(leak):
    none = pressure_of(leak, 0.0)
    change = {area: float(np.abs(pressure_of(leak, area) - none).max()) for area in AREAS_M2}
    assert change[1e-14] < 30.0
    assert change[1e-10] < 200.0


def test_a_leaking_valve_does_not_hold_the_pressure_of_air_that_is_pressed():
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


# --- the lagging spool ---------------------------------------------------------------------------

dampings = st.one_of(st.sampled_from([0.2, 1.0, 2.0]), st.floats(0.2, 2.0))
time_constants_s = st.floats(1e-5, 8e-3)
openings_v = st.floats(-5.0, 5.0)
rates = st.floats(-1e4, 1e4)
commands_v = st.floats(-5.0, 5.0)
durations_s = st.floats(1e-6, 5e-3)


def exact(
    spool: ValveSpool, opening_v: float, rate: float, command_v: float, duration_s: float
) -> NDArray[np.float64]:
    """exp(A t) of s'' = w^2 (u - s) - 2 zeta w s', in time constants to scale the matrix."""
    companion = np.array([[0.0, 1.0], [-1.0, -2.0 * spool.damping_ratio]])
    scaled = expm(companion * duration_s / spool.time_constant_s) @ [
        opening_v - command_v,
        rate * spool.time_constant_s,
    ]
    return np.array([command_v + scaled[0], scaled[1] / spool.time_constant_s])


@given(time_constants_s, dampings, openings_v, rates, commands_v, durations_s)
@examples(max_examples=60, deadline=None)
def test_the_spool_moves_as_a_linear_system_of_second_order(
    time_constant_s, damping, opening_v, rate, command_v, duration_s
):
    spool = ValveSpool(time_constant_s, damping)
    ours = spool_step(spool, opening_v, rate, command_v, duration_s)
    expected = exact(spool, opening_v, rate, command_v, duration_s)
    swing_v = abs(opening_v - command_v) + abs(rate) * time_constant_s
    assert ours[0] == pytest.approx(expected[0], abs=1e-11 * (1 + swing_v))
    assert ours[1] == pytest.approx(expected[1], abs=1e-11 * (1 + swing_v) / time_constant_s)


@pytest.mark.parametrize("damping", [1 - 1e-3, 1 - 1e-9, 1 - 2**-53, 1 + 2**-52, 1 + 1e-9])
def test_the_spool_is_continuous_at_critical_damping(damping):
    near = partial(spool_step, ValveSpool(1.46e-3, damping), 1.0, -200.0, 5.0)
    critical = partial(spool_step, ValveSpool(1.46e-3, 1.0), 1.0, -200.0, 5.0)
    for duration_s in (1e-5, 1e-3, 1e-2):
        difference = 5.0 * abs(damping - 1.0) + 1e-13
        assert near(duration_s)[0] == pytest.approx(critical(duration_s)[0], abs=difference)


def test_a_spool_of_first_order_covers_63_percent_in_its_time_constant_in_any_steps():
    spool = ValveSpool(18e-3, order=1.0)
    opening_v, rate = 1.0, 0.0
    for _ in range(18):
        opening_v, rate = spool_step(spool, opening_v, rate, 4.0, 1e-3)
    assert opening_v == pytest.approx(4.0 - 3.0 / math.e)
    assert rate == pytest.approx(3.0 / math.e / 18e-3)
