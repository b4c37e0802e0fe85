"""Ranges of a fit follow the machine, and never leave what a plant file allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.made_records import pair

from pamctl.diagnose import Record
from pamctl.diagnose.fitting.candidates import list_candidates
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.model_fit import list_free_numbers, recalibrate
from pamctl.diagnose.fitting.numbers import (
    calibrated_number,
    calibration_of,
    list_plant_numbers,
    numbers_of_effect,
    value_of,
    with_values,
)
from pamctl.diagnose.measured.reach import measure_reach
from pamctl.plant.drive import drive_mechanics
from pamctl.plant.flat import parameters_of
from pamctl.plant.model import PlantSettings, values_of

ATMOSPHERE_PA = 101.3e3


def direct(**changes: object) -> PlantSettings:
    """A carriage between springs, as a user would state it."""
    stated = {
        "actuator": "direct",
        "parameters": {"mass_kg": 0.4, "damping_n_s_per_m": 30.0, "stiffness_n_per_m": 4000.0},
    }
    return PlantSettings.model_validate(stated | changes)


def pull(plant: PlantSettings, force_n: float, *, pressure: bool = False) -> Record:
    """Pull a mechanism by a force of this size for six seconds, in steps and sines."""
    t = np.arange(6000) * 1e-3
    shape = np.sin(2 * np.pi * 0.5 * t) + 0.4 * np.sin(2 * np.pi * 3.1 * t)
    felt_n = np.where(t > 0.5, force_n * shape, 0.0)
    pressure_pa = ATMOSPHERE_PA + 3e4 * (1.0 - np.cos(2 * np.pi * 0.8 * t))
    moved = drive_mechanics(parameters_of(values_of(plant)), pressure_pa, 1e-3, force_n=felt_n)
    random = np.random.default_rng(3)
    step_m = 1e-5 * float(np.ptp(moved.position_m))
    return Record(
        "pulled",
        t,
        position_m=np.round(moved.position_m / step_m + random.uniform()) * step_m,
        force_n=felt_n + random.normal(0.0, 1e-3 * force_n, len(t)),
        pressure_pa=pressure_pa if pressure else None,
    )


MUSCLES = {
    "paper": {},
    "twice": {"rest_length_m": 0.4, "braid_length_m": 0.464, "tank_pressure_pa": 700e3},
    "braid near the rest length": {"rest_length_m": 0.2, "braid_length_m": 0.2015},
    "braid near its longest": {"rest_length_m": 0.2, "braid_length_m": 0.3455},
    "at the limits": {
        "rest_length_m": 8.0,
        "braid_length_m": 9.95,
        "tank_pressure_pa": 1.9e6,
        "atmospheric_pressure_pa": 1.95e5,
        "temperature_k": 950.0,
        "heat_capacity_ratio": 1.9,
        "kinetic_friction_per_m": 0.0,
    },
}


@pytest.mark.parametrize("name", MUSCLES)
def test_every_end_of_a_range_is_a_muscle_that_a_plant_file_may_hold(name: str) -> None:
    """A fit that walks to an end of a range must not end in an error."""
    plant = PlantSettings.model_validate({"parameters": MUSCLES[name]})
    for number in (calibrated_number(n, plant) for n in list_plant_numbers(plant)):
        assert number.low <= value_of(plant, number.name) <= number.high
        for end in (number.low, number.high):
            assert value_of(with_values(plant, {number.name: end}), number.name) == end


def test_a_guess_three_times_off_is_inside_its_range() -> None:
    muscle = PlantSettings()
    for name in ("valve_gain_m2_per_v", "damping_n_s_per_m", "stiffness_n_per_m", "mass_kg"):
        number = calibrated_number(name, muscle)
        assert number.low < value_of(muscle, name) / 3.0
        assert number.high > value_of(muscle, name) * 3.0
    carriage = direct(effects={"piston": {"area_m2": 5e-4}, "coulomb_friction": {"force_n": 35.0}})
    evidence = prepare_evidence(*([pull(carriage, 40.0, pressure=True)],) * 2, carriage)
    for number in list_free_numbers(frozenset(evidence.blocks), (), evidence):
        value = value_of(carriage, number.name)
        assert number.low <= value / 3.0
        assert number.high >= value * 3.0


@pytest.mark.parametrize("force_n", [0.05, 40.0, 30e3])
def test_ranges_of_effects_grow_with_the_machine(force_n: float) -> None:
    """The same carriage with all forces scaled: a watch, a bench, a press."""
    by = force_n / 40.0
    parameters = {n: by * value_of(direct(), n) for n in calibration_of("mechanics", direct())[:3]}
    plant = direct(parameters=parameters)
    record = pull(plant, force_n, pressure=True)
    evidence = prepare_evidence([record], [record], plant)
    ranges = {f.name: f for c in list_candidates(evidence) for f in c.free}
    assert ranges["coulomb_friction.force_n"].high == pytest.approx(1.4 * force_n, rel=0.1)
    half_n, way_m = 1.4 * force_n, float(np.ptp(record.position_m))
    assert ranges["cubic_stiffness.n_per_m3"].high == pytest.approx(
        100 * half_n / way_m**3, rel=0.1
    )
    assert ranges["presliding.compliance_m_per_n"].high == pytest.approx(way_m / half_n, rel=0.1)
    assert "pressure_friction.n_per_pa" in ranges
    for candidate in list_candidates(evidence):
        most = {number.name: number.high for number in candidate.free}
        extreme = with_values(plant, most)
        assert {name: value_of(extreme, name) for name in most} == most
    found = recalibrate(evidence).fit_of("mechanics").values
    for name, value in parameters.items():
        assert found[name] == pytest.approx(value, rel=0.05)


def test_without_a_force_the_area_of_the_piston_is_the_measure_of_all_forces() -> None:
    """Pressure and motion show ratios of forces only: one factor before all changes nothing."""
    cylinder = direct(effects={"piston": {"area_m2": 5e-4}})
    pulled = pull(cylinder, 0.0, pressure=True)
    unmeasured = replace(pulled, force_n=None)

    def free(record: Record, **changes: object) -> set[str]:
        plant = cylinder.model_copy(update=changes)
        evidence = prepare_evidence([record], [record], plant)
        return {f.name for f in list_free_numbers(frozenset({"mechanics"}), (), evidence)}

    assert "piston.area_m2" not in free(unmeasured)
    assert "piston.area_m2" in free(unmeasured, known=("mass_kg",))
    assert "piston.area_m2" in free(pull(cylinder, 40.0, pressure=True))
    guessed = cylinder.model_copy(
        update={"parameters": cylinder.parameters.model_copy(update={"mass_kg": 0.9})}
    )
    found = recalibrate(prepare_evidence([unmeasured], [unmeasured], guessed))
    assert found.fit_of("mechanics").values["mass_kg"] == pytest.approx(0.4, rel=0.05)


def test_the_ranges_of_a_chamber_grow_with_its_valve_and_its_volume() -> None:
    parameters = {"valve_gain_m2_per_v": 1.03e-4}
    large = PlantSettings.model_validate(
        {"actuator": "chamber", "chamber_volume_m3": 9.24e-3, "parameters": parameters}
    )
    paper = PlantSettings()
    for effect, number in (("chamber_leak", "area_m2"), ("dead_volume", "volume_m3")):
        (usual,) = numbers_of_effect(effect, [number], paper)
        (here,) = numbers_of_effect(effect, [number], large)
        assert here.high == pytest.approx(100.0 * usual.high, rel=0.01)
        assert here.scale == pytest.approx(100.0 * usual.scale, rel=0.01)


def test_a_known_number_is_not_fitted() -> None:
    stated = {"effects": {"piston": {"area_m2": 5e-4}, "coulomb_friction": {"force_n": 2.0}}}
    every = direct(**stated)
    record = pull(every, 40.0, pressure=True)

    def free(plant: PlantSettings) -> set[str]:
        evidence = prepare_evidence([record], [record], plant)
        return {f.name for f in list_free_numbers(frozenset(evidence.blocks), (), evidence)}

    some = direct(**stated, known=["mass_kg", "piston.area_m2", "external_load.force_n"])
    assert free(every) - free(some) == {"mass_kg", "piston.area_m2", "external_load.force_n"}
    assert with_values(some, {"damping_n_s_per_m": 1.0}).known == some.known


def test_a_mechanism_without_air_is_not_asked_about_air() -> None:
    """An effect that moves nothing here is no candidate, though another might wake it."""
    plant = direct()
    dry = pull(plant, 40.0)
    names = {c.name for c in list_candidates(prepare_evidence([dry], [dry], plant))}
    assert not names & {"line_restriction", "piston", "pressure_friction", "pressure_damping"}
    assert not names & {"return_friction", "braid_stretch", "bladder_threshold", "external_load"}
    # These two need dry friction, which may be missing as well.
    assert {"stribeck", "presliding", "coulomb_friction", "viscous_asymmetry"} <= names
    wet = pull(plant, 40.0, pressure=True)
    pressed = {c.name for c in list_candidates(prepare_evidence([wet], [wet], plant))}
    assert pressed - names >= {"piston", "pressure_friction", "pressure_damping"}


def test_a_muscle_is_asked_about_what_it_was_asked_before() -> None:
    names = {c.name for c in list_candidates(prepare_evidence(*pair(), PlantSettings()))}
    assert not names & {"piston", "pressure_friction", "friction_asymmetry", "viscous_asymmetry"}
    assert len(names) == 30


@pytest.mark.parametrize("hz", [10, 100, 1000])
def test_the_reach_is_that_of_the_motion_and_not_of_its_noise(hz: int) -> None:
    t = np.arange(20 * hz) / hz
    random = np.random.default_rng(5)
    x = 0.1 * np.sin(2 * np.pi * 0.3 * t) + random.normal(0.0, 1e-5, len(t))
    record = Record("sine", t, position_m=x, force_n=50.0 + 20.0 * np.cos(2 * np.pi * 0.3 * t))
    reach = measure_reach([record], direct(), 1e-5, 0.0)
    assert reach.speed_m_per_s == pytest.approx(0.1 * 2 * np.pi * 0.3, rel=0.05)
    assert reach.travel_m == pytest.approx(0.2, rel=0.01)
    assert reach.force_n == pytest.approx(20.0, rel=0.01)
    assert reach.load_n == pytest.approx(70.0, rel=0.01)


def test_pressure_alone_drives_a_piston_and_its_numbers_come_back() -> None:
    """A free cylinder on a spring, without a force sensor; the guesses are three times off."""
    numbers = {"mass_kg": 2.0, "damping_n_s_per_m": 120.0, "stiffness_n_per_m": 3000.0}
    truth = direct(parameters=numbers, effects={"piston": {"area_m2": 8e-4}})
    t = np.arange(6000) * 1e-3
    pressure_pa = ATMOSPHERE_PA + 4e4 * (1.0 - np.cos(2 * np.pi * (0.4 + 0.3 * t) * t))
    moved = drive_mechanics(parameters_of(values_of(truth)), pressure_pa, 1e-3, steps=8)
    record = Record(
        "pressed", t, position_m=np.round(moved.position_m / 1e-6) * 1e-6, pressure_pa=pressure_pa
    )
    # The spring is known: pressure shows every force over the area only.
    guess = direct(
        parameters={"mass_kg": 6.0, "damping_n_s_per_m": 40.0, "stiffness_n_per_m": 3000.0},
        effects={"piston": {"area_m2": 4e-4}},
        known=["stiffness_n_per_m"],
    )
    found = recalibrate(prepare_evidence([record], [record], guess)).fit_of("mechanics").values
    assert found["mass_kg"] == pytest.approx(2.0, rel=0.03)
    assert found["damping_n_s_per_m"] == pytest.approx(120.0, rel=0.03)
    assert found["piston.area_m2"] == pytest.approx(8e-4, rel=0.01)
