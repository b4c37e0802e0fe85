"""What a diagnosis leaves out changes nothing: repeated and needless simulations, fine steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.made_records import pair

from pamctl.bounded_memory import BoundedMemory
from pamctl.diagnose.fitting import block_fit as of_fits
from pamctl.diagnose.fitting import drives as of_drives
from pamctl.diagnose.fitting import floor as of_floor
from pamctl.diagnose.fitting.block_fit import (
    QUICK,
    Fit,
    find_change,
    find_secants,
    fit_numbers,
    sensitivity,
)
from pamctl.diagnose.fitting.coarse_steps import coarsen
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, Drive, stack_residuals
from pamctl.diagnose.fitting.evidence import Evidence, prepare_evidence
from pamctl.diagnose.fitting.floor import imitate_records
from pamctl.diagnose.fitting.numbers import calibrated_number, with_values
from pamctl.diagnose.setup.altered_drive import PlantChange, add_change
from pamctl.plant.drive import drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters

PAPER = PlantSettings()
OF_PRESSURE = {"valve_gain_m2_per_v": 1.1e-6, "chamber_leak.area_m2": 1e-8}
OF_MECHANICS = {"damping_n_s_per_m": 600.0, "coulomb_friction.force_n": 3.0}


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    return prepare_evidence(*pair(), PAPER)


def count_simulations(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    found: list[str] = []
    anew = Drive._simulate_anew

    def counted(drive: Drive, p: object) -> object:
        found.append(drive.block)
        return anew(drive, p)  # type: ignore[arg-type]

    monkeypatch.setattr(of_drives, "_SIMULATED", BoundedMemory(100_000_000))
    monkeypatch.setattr(Drive, "_simulate_anew", counted)
    return found


def test_a_block_is_simulated_as_if_all_its_numbers_counted(evidence: Evidence) -> None:
    """Numbers that a block does not depend on are made neutral: the same bits come out."""
    p = plant_parameters(with_values(PAPER, {**OF_PRESSURE, **OF_MECHANICS}))
    air, axis = evidence.train[PRESSURE][0], evidence.train[MECHANICS][0]
    pressure_pa = drive_pressure(p, air.valve_v, air.driven, air.grid).pressure_pa
    position_m = drive_mechanics(p, axis.driven, axis.grid).position_m
    np.testing.assert_array_equal(air.simulate_with(p), pressure_pa)
    np.testing.assert_array_equal(axis.simulate_with(p), position_m)


def test_a_block_is_simulated_again_only_for_its_own_numbers(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated = count_simulations(monkeypatch)
    both = [evidence.train[PRESSURE][0], evidence.train[MECHANICS][0]]
    before = stack_residuals(both, PAPER)
    simulated.clear()
    np.testing.assert_array_equal(stack_residuals(both, PAPER), before)
    assert simulated == []
    stack_residuals(both, with_values(PAPER, OF_MECHANICS))
    assert simulated == [MECHANICS]
    simulated.clear()
    stack_residuals(both, with_values(PAPER, OF_PRESSURE))
    assert simulated == [PRESSURE]


def test_derivatives_of_the_other_block_are_zero(evidence: Evidence) -> None:
    both = [evidence.train[PRESSURE][0], evidence.train[MECHANICS][0]]
    free = [calibrated_number(n, PAPER) for n in ("valve_gain_m2_per_v", "damping_n_s_per_m")]
    slope, samples = sensitivity(both, PAPER, free), both[0].samples
    assert not slope[samples:, 0].any()
    assert not slope[:samples, 1].any()
    assert slope[:samples, 0].any()
    assert slope[samples:, 1].any()


@pytest.mark.parametrize(
    ("block", "name", "dose"),
    [
        (PRESSURE, "tank_pressure_pa", 4.43e5),
        (PRESSURE, "valve_deadband.fill_width_v", 0.05),
        (PRESSURE, "polytropic.exponent", 1.05),
        (PRESSURE, "command_delay.delay_s", 1.3e-3),
        (MECHANICS, "stiffness_n_per_m", 9700.0),
        (MECHANICS, "kinetic_friction_per_m", 55.5),
    ],
)
def test_half_the_steps_show_a_dose_as_well(
    evidence: Evidence, block: str, name: str, dose: float
) -> None:
    drives = evidence.train[block]
    before, after = (stack_residuals(drives, p) for p in (PAPER, with_values(PAPER, {name: dose})))
    fine = after - before
    fitted = Fit(PAPER, (), drives, before)
    coarse = find_secants(fitted, [{name: dose}])[:, 0]
    assert np.linalg.norm(coarse + fine) < 0.03 * np.linalg.norm(fine)


def test_the_zero_of_the_pressure_sensor_is_added_to_a_known_simulation(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    air = evidence.train[PRESSURE][0]
    zeros = {"pressure_sensor_offset.offset_pa": 130.0, "pressure_sensor_gain.gain": 1.02}
    p = plant_parameters(with_values(PAPER, zeros))
    whole = drive_pressure(p, air.valve_v, air.driven, air.grid).pressure_pa
    simulated = count_simulations(monkeypatch)
    air.simulate_with(plant_parameters(with_values(PAPER, {"pressure_sensor_gain.gain": 1.02})))
    np.testing.assert_allclose(air.simulate_with(p), whole, rtol=1e-15)
    assert simulated == [PRESSURE]


def test_windows_start_from_a_reading_that_the_zero_moves(evidence: Evidence) -> None:
    air = replace(evidence.train[PRESSURE][0], windows=(slice(0, 900), slice(900, 2000)))
    p = plant_parameters(with_values(PAPER, {"pressure_sensor_offset.offset_pa": 900.0}))
    whole = drive_pressure(p, air.valve_v, air.driven, air.grid, restarts=air._restarts)
    np.testing.assert_array_equal(air.simulate_with(p), whole.pressure_pa)


def test_half_the_steps_show_what_an_altered_drive_changes(evidence: Evidence) -> None:
    drives = evidence.train[PRESSURE]
    fitted = Fit(PAPER, (), drives, stack_residuals(drives, PAPER))
    altered = [add_change(d, PlantChange("temperature_k", 0.02)) for d in drives]
    fine = stack_residuals(altered, PAPER) - fitted.residual
    assert np.linalg.norm(find_change(fitted, altered) - fine) < 0.03 * np.linalg.norm(fine)


def test_the_fine_steps_go_on_with_the_derivatives_of_the_coarse_ones(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end is that of a descent with all steps alone, for fewer derivatives."""
    free = [calibrated_number(n, PAPER) for n in ("valve_gain_m2_per_v", "tank_pressure_pa")]
    start = with_values(PAPER, {"valve_gain_m2_per_v": 1.2e-6, "tank_pressure_pa": 4.3e5})
    drives, asked = evidence.train[PRESSURE], []
    monkeypatch.setattr(of_fits, "sensitivity", lambda *g: asked.append(1) or sensitivity(*g))
    found = fit_numbers(drives, start, free)
    count = len(asked)
    monkeypatch.setattr(of_fits, "coarsen", lambda drives, *plants, free=(): tuple(drives))
    alone = fit_numbers(drives, start, free)
    assert count <= len(asked) - count + 1
    for number in free:
        apart = abs(found.values[number.name] - alone.values[number.name])
        assert apart < 1e-3 * number.scale


def test_a_short_time_constant_needs_all_the_steps(evidence: Evidence) -> None:
    drives = evidence.train[PRESSURE]
    assert coarsen(drives, PAPER) != drives
    assert coarsen(drives, with_values(PAPER, {"valve_spool.time_constant_s": 1e-3})) == drives
    slow = with_values(PAPER, {"creep.stiffness_n_per_m": 500.0, "creep.time_constant_s": 1.0})
    assert coarsen(drives, slow) != drives


def test_inputs_whose_noise_hardly_moves_the_output_leave_the_floor_as_it_is(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [calibrated_number("valve_gain_m2_per_v", PAPER)]
    fitted = fit_numbers(evidence.train[PRESSURE], PAPER, free, QUICK)
    given = (fitted, evidence.holdout[PRESSURE], evidence.noises)
    simulated = count_simulations(monkeypatch)
    fast = imitate_records(*given)
    few = len(simulated)
    monkeypatch.setattr(of_floor, "DEAF", 0.0)
    simulated.clear()
    full = of_floor._imitate_anew(*given, of_floor.REPLICAS)
    assert len(simulated) > few + of_floor.REPLICAS
    levels = [np.sqrt(np.mean(found.residuals**2)) for found in (fast, full)]
    assert levels[0] == pytest.approx(levels[1], rel=1e-3)


def test_a_memory_forgets_what_was_not_asked_for_longest() -> None:
    memory: BoundedMemory[tuple[np.ndarray]] = BoundedMemory(2 * 80)
    made: list[str] = []

    def ask(key: str) -> None:
        memory.recall(key, (), lambda: (made.append(key) or np.zeros(10),))

    for key in ("a", "b", "a", "c", "a", "b"):
        ask(key)
    assert made == ["a", "b", "c", "b"]
