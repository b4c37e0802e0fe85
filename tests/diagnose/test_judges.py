"""What a model is judged by: a free run, windows from the measured state, or its equation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import savgol_filter
from support.free_mass import (
    DAMPING,
    FRICTION_N,
    LOAD_N,
    MASS_KG,
    axis,
    imposed_motion,
    leave_gaps,
    pushed_mass,
)
from support.made_records import measured, pair

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.fitting.block_fit import fit_numbers, rms
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import list_free_numbers, recalibrate
from pamctl.diagnose.fitting.numbers import FreeNumber
from pamctl.diagnose.judging.judges import JudgeKind
from pamctl.diagnose.judging.segments import (
    count_samples,
    find_segments,
    find_strokes,
    smooth_by_cubic,
)
from pamctl.diagnose.judging.windows import build_start_modes, cut_windows, estimate_starts
from pamctl.diagnose.locate import draw_noise, locate_misfits
from pamctl.diagnose.naming.unseen import hold_unseen_numbers, list_unseen
from pamctl.diagnose.report.phrases import describe_bounds
from pamctl.plant.drive import Restarts, count_steps, drive_mechanics, drive_pressure
from pamctl.plant.flat import parameters_of
from pamctl.plant.model import PlantSettings
from pamctl.plant.parameters import rest_state

PAPER = PlantSettings()
KNOWN = {"coulomb_friction": {"force_n": FRICTION_N}, "external_load": {"force_n": LOAD_N}}
TRUTH = axis(**KNOWN)


def test_a_restart_goes_on_from_the_given_state() -> None:
    """With constant force and friction a mass flies a parabola from any state."""
    p = parameters_of(
        {
            "actuator": 1.0,
            "mass_kg": 10.0,
            "damping_n_s_per_m": 1e-6,
            "stiffness_n_per_m": 0.0,
            "coulomb_friction.force_n": 5.0,
        }
    )
    samples, row, x, v = 400, 150, 0.3, 0.7
    again = Restarts(np.array([row]), np.array([x]), np.array([v]))
    still = np.full(samples, p.atmospheric_pressure_pa)
    driven = drive_mechanics(p, still, 1e-3, force_n=np.full(samples, 25.0), restarts=again)
    t_s = 1e-3 * np.arange(samples - row)
    assert driven.position_m[row:] == pytest.approx(x + v * t_s + t_s**2, abs=1e-7)
    t_s = 1e-3 * np.arange(row)
    assert driven.position_m[:row] == pytest.approx(t_s**2, abs=1e-7)


def test_errors_of_the_starts_do_not_count_and_missing_friction_does() -> None:
    """A start off by d and w moves d + w T (1 - e^(-t/T)); a force off by f moves f t^2 / (2 M).

    What a line leaves of t^2 over a window h has an RMS of h^2 / (6 sqrt 5).
    """
    t_s = 1e-3 * np.arange(2000)
    windows = cut_windows([slice(0, 2000)], 100)
    since_s = t_s - np.repeat([t_s[w.start] for w in windows], [w.stop - w.start for w in windows])
    lost = 2e-3 + 0.05 * 0.4 * -np.expm1(-since_s / 0.4)
    assert rms(build_start_modes(t_s, windows, 0.4).project_out(lost)) < 1e-15
    missing = 20.0 * since_s**2 / (2.0 * 95.0)
    left = rms(build_start_modes(t_s, windows, np.inf).project_out(missing))
    assert left == pytest.approx(20.0 / (2.0 * 95.0) * 0.1**2 / (6.0 * np.sqrt(5.0)), rel=0.02)


def test_a_start_is_found_as_exactly_as_the_noise_allows() -> None:
    t_s = 1e-3 * np.arange(4000)
    moved = 0.2 * np.sin(3.0 * t_s)
    shown = moved + np.random.default_rng(3).normal(0.0, 1e-6, len(t_s))
    starts = estimate_starts(t_s, shown, cut_windows([slice(0, 4000)], 100), 1e-6)
    assert rms(starts.outputs - moved[starts.rows]) < 2e-6
    assert rms(starts.rates - 0.6 * np.cos(3.0 * t_s[starts.rows])) < 6e-4
    still = estimate_starts(t_s, shown - moved, (slice(0, 100),), 1e-6)
    assert still.rates[0] == 0.0


def test_a_start_does_not_look_past_the_moment_at_which_the_mass_stops() -> None:
    t_s = 1e-3 * np.arange(100)
    stopping = np.where(t_s < 7e-3, 4e-3 * t_s, 4e-3 * 7e-3)
    starts = estimate_starts(t_s, stopping, (slice(0, 100),), 1e-7)
    assert starts.rates[0] == pytest.approx(4e-3, rel=0.02)


def test_a_free_mass_is_judged_in_windows_of_a_horizon_that_its_noise_sets() -> None:
    """The noise of the force moves a mass by force h^1.5 / mass: eight times more, h / 4."""
    horizons = []
    for noise_n in (0.5, 4.0):
        records = [pushed_mass(1, force_noise_n=noise_n)]
        judge = prepare_evidence(records, records, axis()).judge[MECHANICS]
        assert judge.kind is JudgeKind.WINDOWS
        assert "noise of the force" in judge.why
        horizons.append(judge.horizon_s)
    assert horizons[0] / horizons[1] == pytest.approx(4.0, rel=0.35)


def test_in_windows_the_truth_is_at_its_floor_and_friction_shows_beside_the_drift() -> None:
    evidence = prepare_evidence([pushed_mass(1)], [pushed_mass(2)], TRUTH)
    free = list_free_numbers(frozenset({MECHANICS}), (), evidence)
    assert {"mass_kg", "damping_n_s_per_m", "external_load.force_n"} <= {f.name for f in free}
    model = recalibrate(evidence)
    floor = model.floors[MECHANICS]
    assert floor.mean < 2.0
    assert model.rms[MECHANICS] < floor.limit
    without = recalibrate(prepare_evidence([pushed_mass(1)], [pushed_mass(2)], axis()))
    assert without.rms[MECHANICS] > 10.0 * floor.limit
    (drive,) = evidence.holdout[MECHANICS]
    free_run = replace(drive, windows=(), has_known_start=True)
    assert rms(free_run.residual(TRUTH)) > 100.0 * rms(drive.residual(TRUTH))


@pytest.mark.parametrize("factor", [0.33, 3.0])
def test_a_guess_three_times_off_is_found(factor: float) -> None:
    start = axis(factor, coulomb_friction={"force_n": 5.0})
    evidence = prepare_evidence([pushed_mass(1)], [pushed_mass(2)], start)
    values = recalibrate(evidence).fit_of(MECHANICS).values
    assert values["mass_kg"] == pytest.approx(MASS_KG, rel=0.01)
    assert values["damping_n_s_per_m"] == pytest.approx(DAMPING, rel=0.03)
    assert values["coulomb_friction.force_n"] == pytest.approx(FRICTION_N, rel=0.03)
    assert values["external_load.force_n"] == pytest.approx(LOAD_N, abs=0.1)


def test_a_mass_on_a_spring_and_a_muscle_run_freely() -> None:
    sprung = [pushed_mass(1, duration_s=12.0, stiffness=2e5)]
    judge = prepare_evidence(sprung, sprung, axis(stiffness=1e5)).judge[MECHANICS]
    assert judge.kind is JudgeKind.FREE_RUN
    evidence = prepare_evidence(*pair(), PAPER)
    assert {j.kind for j in evidence.judge.values()} == {JudgeKind.FREE_RUN}
    assert all(not d.windows for drives in evidence.train.values() for d in drives)


def test_an_imposed_motion_is_judged_by_its_equation_as_a_straight_least_squares() -> None:
    records = [imposed_motion(1)]
    start = axis(mass_kg=0.3, coulomb_friction={"force_n": 2.0})
    evidence = prepare_evidence(records, records, start)
    assert evidence.judge[MECHANICS].kind is JudgeKind.EQUATION
    (drive,) = evidence.train[MECHANICS]
    assert drive.channel == "force_n"
    free = [
        FreeNumber("damping_n_s_per_m", 1.0, 4e3, 1.0),
        FreeNumber("coulomb_friction.force_n", 0.0, 40.0, 0.1, is_calibrated=True),
        FreeNumber("external_load.force_n", -20.0, 20.0, 0.1, is_calibrated=True),
    ]
    found = fit_numbers((drive,), start, free).values
    v = drive.differentiate_motion(drive.slope_s, 1)
    a = drive.differentiate_motion(drive.slope_s, 2)
    columns = np.column_stack([v, np.sign(v), np.ones(len(v))])[drive.rows]
    target = (drive.measured - start.parameters.mass_kg * a)[drive.rows]
    by_hand = np.linalg.lstsq(columns, target, rcond=None)[0]
    fitted = [found["damping_n_s_per_m"], found["coulomb_friction.force_n"]]
    assert fitted == pytest.approx(by_hand[:2], rel=1e-3)
    assert by_hand[:2] == pytest.approx([400.0, 6.0], rel=0.05)
    assert abs(found["external_load.force_n"]) == pytest.approx(2.0, abs=0.05)
    model = recalibrate(evidence)
    assert model.rms[MECHANICS] < model.floors[MECHANICS].limit


def test_a_late_pressure_that_hides_the_mass_is_judged_in_windows() -> None:
    """A late pressure turns damping into a negative mass: c v(t - T) = c v - c T a."""
    record = imposed_motion(1)
    late_pa = np.roll(101.3e3 + record["force_n"] / 5e-4, 3)
    records = [replace(record, force_n=None, pressure_pa=late_pa)]
    judge = prepare_evidence(records, records, axis(piston={"area_m2": 5e-4})).judge[MECHANICS]
    assert (judge.kind, judge.velocity_time_s) == (JudgeKind.WINDOWS, 0.0)
    assert judge.horizon_s is not None
    assert 0.0 < judge.horizon_s < 3.0


def sealed_chamber(seed: int, leak_m2: float = 0.0, *, with_valve: bool = True) -> Record:
    """Fill a muscle to 3 bar, close its valve, and move it."""
    t_s = 1e-3 * np.arange(8000)
    x = 4e-3 * (1.0 - np.cos(2.5 * t_s)) + 3e-3 * np.sin(8.0 * t_s) ** 2
    p = parameters_of({"chamber_leak.area_m2": leak_m2})
    closed_v = np.zeros(len(t_s))
    held = drive_pressure(p, closed_v, x, 1e-3, start=rest_state(p, 0.0, 3e5), steps=8)
    noise_pa = np.random.default_rng(seed).normal(0.0, 300.0, len(t_s))
    return Record(
        f"sealed-{seed}",
        t_s,
        valve_v=closed_v if with_valve else None,
        pressure_pa=held.pressure_pa + noise_pa,
        position_m=x,
    )


def test_a_sealed_chamber_is_judged_in_windows_in_which_a_leak_shows() -> None:
    levels = {}
    for leak_m2 in (0.0, 5e-9):
        records = [sealed_chamber(1, leak_m2)], [sealed_chamber(2, leak_m2)]
        evidence = prepare_evidence(*records, PAPER).select_blocks({PRESSURE})
        assert evidence.judge[PRESSURE].kind is JudgeKind.WINDOWS
        (drive,) = evidence.holdout[PRESSURE]
        levels[leak_m2] = rms(drive.residual(PAPER))
    assert levels[0.0] == pytest.approx(1.0, abs=0.05)
    assert levels[5e-9] > 2.0


def test_a_gap_begins_a_new_window_and_the_muscle_goes_on_from_there() -> None:
    """Without a new start the vented model would have missed what the valve did in the gap."""
    records = [[leave_gaps(r, (1500, 1900), (4000, 4100))] for (r,) in pair()]
    evidence = prepare_evidence(*records, PAPER)
    for block, drives in evidence.holdout.items():
        (drive,) = drives
        assert evidence.judge[block].kind is JudgeKind.WINDOWS
        assert [w.start for w in drive.windows] == [0, 1500, 3600]
    model = recalibrate(evidence)
    assert all(model.rms[b] < model.floors[b].limit for b in evidence.blocks)
    (drive,) = evidence.holdout[PRESSURE]
    assert rms(replace(drive, windows=()).residual(PAPER)) > 3.0 * model.rms[PRESSURE]


def test_filters_and_steps_are_times_and_not_samples() -> None:
    noisy = np.random.default_rng(1).normal(size=300)
    np.testing.assert_allclose(
        smooth_by_cubic(noisy, 1e-3), savgol_filter(noisy, 15, 3), atol=1e-12
    )
    assert (smooth_by_cubic(noisy, 1e-2) == noisy).all()
    assert count_samples(0.031, 1e-3) == 31
    assert count_samples(0.031, 0.1) == 1
    assert [count_steps(period_s) for period_s in (1e-4, 1e-3, 1.02e-3, 1e-2, 0.1)] == [
        2, 2, 2, 20, 200,
    ]  # fmt: skip


def test_a_slow_record_of_a_fast_valve_is_simulated_as_finely_as_a_fast_record() -> None:
    fast = measured("judge", 2)
    slow = Record("slow", fast.t_s[::10], **{c: fast[c][::10] for c in fast.channels})
    held_v = np.repeat(slow["valve_v"], 10)[: len(fast)]
    again = drive_pressure(parameters_of({}), held_v, fast["position_m"], 1e-3).pressure_pa
    (drive,) = prepare_evidence([slow], [slow], PAPER).train[PRESSURE]
    assert drive.steps == 20
    assert rms(drive.simulate(PAPER) - again[::10]) < 500.0


def test_segments_end_at_gaps_and_not_at_missed_ticks() -> None:
    step_s = np.full(99, 1e-3)
    step_s[20], step_s[60] = 4e-3, 0.3
    assert find_segments(step_s) == (slice(0, 61), slice(61, 100))


def test_a_stroke_is_the_middle_of_a_motion_in_one_direction() -> None:
    direction = np.repeat([0.0, 1.0, -1.0], [10, 100, 50])
    assert find_strokes(direction, [slice(0, 160)], 3) == (slice(20, 100), slice(115, 155))
    assert find_strokes(direction, [slice(0, 60), slice(60, 160)], 30) == ()


def recalibrated_piston() -> Model:
    plant = axis(coulomb_friction={"force_n": 6.0})
    return recalibrate(prepare_evidence([imposed_motion(1)], [imposed_motion(2)], plant))


def test_where_noise_is_unknown_the_regimes_are_measured_by_the_estimated_floor() -> None:
    model = recalibrated_piston()
    known = model.floors[MECHANICS]
    level = 3.0 * known.mean
    model.__dict__["floors"] = {MECHANICS: known.with_level(level, 1.5 * level, 0.0)}
    assert rms(draw_noise(model, MECHANICS)) == pytest.approx(level)
    whole = model.ratio(MECHANICS)
    for misfit in locate_misfits(model):
        assert misfit.residual_over_floor == pytest.approx(whole, rel=0.2)


@pytest.mark.long
def test_a_mass_that_no_record_shows_stays_that_of_the_plant_file() -> None:
    runs = [imposed_motion(1)], [imposed_motion(2)]
    first = diagnose(*runs, axis(mass_kg=0.6))
    assert first.plant.parameters.mass_kg == 0.6
    assert first.model is not None
    assert list_unseen(first.model) == ("mass_kg",)
    assert "These records do not show mass_kg" in describe_bounds(first)
    again = diagnose(*runs, first.plant)
    assert again.plant.parameters.mass_kg == 0.6


def test_a_mass_that_the_records_show_is_fitted() -> None:
    runs = [pushed_mass(1)], [pushed_mass(2)]
    base = recalibrate(prepare_evidence(*runs, axis(20.0, coulomb_friction={"force_n": 20.0})))
    assert hold_unseen_numbers(base) is base
    assert base.values["mass_kg"] == pytest.approx(MASS_KG, rel=0.01)
