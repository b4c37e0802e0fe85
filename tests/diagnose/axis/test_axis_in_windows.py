"""An axis judged in windows: cogging, a late column, another clock, play, how a window begins."""

from math import copysign, exp, pi, sin

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.made_records import ask_only, axis_plant, list_asked, numbers_of

from pamctl.diagnose import Diagnosis, Record, diagnose, report_diagnosis, sentence
from pamctl.diagnose.evidence.measured_columns import find_starts, judge_motion
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page
from pamctl.plant.drive import Restarts, drive_mechanics
from pamctl.plant.parameters import parameters_of
from pamctl.report.html_page import write_html
from pamctl.report.report import format_terminal

MASS_KG, DAMPING, DRY_N, COGGING_N, PITCH_M = 3.1, 28.0, 1.5, 3.2, 0.016
PERIOD_S, STEPS, LASTS_S = 1e-3, 10, 10.0


def positioned(seed: int, cogging_n: float = COGGING_N) -> Record:
    """Let a stiff controller bring the axis from place to place; the force is measured."""
    random, dt_s = np.random.default_rng(seed), PERIOD_S / STEPS
    x, v, force, aim, goal = 0.05, 0.0, 0.0, 0.05, 0.05
    rows = np.empty((round(LASTS_S / PERIOD_S), 2))
    for k in range(len(rows)):
        if k % 500 == 0:
            goal = random.uniform(0.02, 0.25)
        aim += (goal - aim) * PERIOD_S / 0.06
        rows[k] = force, x
        wanted = 3000.0 * (aim - x) - 110.0 * v
        for _ in range(STEPS):
            force += dt_s * (wanted - force) / 0.002
            pushes = force - DAMPING * v - cogging_n * sin(2.0 * pi * x / PITCH_M + 0.4)
            free, most = v + dt_s * pushes / MASS_KG, dt_s * DRY_N / MASS_KG
            v = 0.0 if abs(free) <= most else free - copysign(most, free)
            x += dt_s * v
    force_n, position_m = rows.T
    return Record(
        f"positioned-{seed}",
        np.arange(len(rows)) * PERIOD_S,
        force_n=force_n + random.normal(0.0, 0.1, len(rows)),
        position_m=np.round(position_m / 1e-6) * 1e-6,
    )


def test_the_period_of_cogging_is_found_from_what_it_does_to_a_free_mass():
    records = [positioned(seed) for seed in (1, 2, 3)]
    plant = axis_plant(3.0, 22.0, coulomb_friction={"force_n": 1.0})
    asked = ask_only("force~wave", "stribeck", "damping~curve", of=list_asked(records, plant))
    found = diagnose(records[:2], records[2:], plant, without=asked)
    assert found.evidence is not None
    assert found.evidence.weigher.train.windowed
    (wave,) = found.findings
    values = numbers_of(found)
    assert values["force_term.inner"] == pytest.approx(PITCH_M, rel=1e-3)
    assert np.hypot(*(n.value for n in wave.numbers[:2])) == pytest.approx(COGGING_N, rel=0.01)
    assert values["coulomb_friction.force_n"] == pytest.approx(DRY_N, rel=0.01)


# --- a position that is logged late, or by another clock -----------------------------------------

LATE = 3
"""Samples of 1 ms."""
CLOCK = 3e-4


def log_late(record: Record) -> Record:
    """Return a record whose position stands so many samples below the force that it had."""
    assert record.force_n is not None
    assert record.position_m is not None
    return Record(
        record.name,
        record.t_s[:-LATE],
        force_n=record.force_n[LATE:],
        position_m=record.position_m[:-LATE],
    )


def hold_force(record: Record) -> Record:
    """Return a record whose position answers a force that is held for a sample."""
    t_s, position_m = record.t_s, record.position_m
    assert position_m is not None
    half_later_m = np.interp(t_s - 0.5e-3, t_s, position_m)
    return Record(record.name, t_s, force_n=record.force_n, position_m=half_later_m)


def log_by_another_clock(record: Record) -> Record:
    """Return a record whose position is sampled by a clock that is slow by 3e-4."""
    t_s, position_m = record.t_s[:-5], record.position_m
    assert position_m is not None
    assert record.force_n is not None
    sampled_m = np.interp(t_s * (1.0 + CLOCK), record.t_s, position_m)
    return Record(record.name, t_s, force_n=record.force_n[:-5], position_m=sampled_m)


AXIS = axis_plant(3.0, 22.0, coulomb_friction={"force_n": 1.0})


def test_a_force_that_is_held_from_sample_to_sample_makes_no_late_position():
    held = [hold_force(positioned(seed, cogging_n=0.0)) for seed in (1, 2)]
    asked = ask_only("presliding", "late", "mass", "clock", of=list_asked(held, AXIS))
    found = diagnose(held, [], AXIS, without=asked)
    assert not found.findings
    assert numbers_of(found)["~apart.position_m"] == pytest.approx(0.5e-3, abs=2e-4)


def test_another_clock_is_found_where_each_window_begins_with_the_measured_state():
    drifting = [log_by_another_clock(positioned(seed, cogging_n=0.0)) for seed in (1, 2)]
    asked = ask_only("presliding", "late", "mass", "clock", of=list_asked(drifting, AXIS))
    found = diagnose(drifting, [], AXIS, without=asked)
    assert [f.name for f in found.findings] == ["position_clock"]
    assert numbers_of(found)["~clock.position_m"] == pytest.approx(CLOCK, rel=0.05)


def test_a_late_position_is_found_where_each_window_begins_with_the_measured_state():
    plant = axis_plant(3.0, 22.0)
    late = [log_late(positioned(seed, cogging_n=0.0)) for seed in (1, 2)]
    asked = "coulomb_friction", "presliding", "late"
    found = diagnose(late, [], plant, without=ask_only(*asked, of=list_asked(late, plant)))
    numbers = numbers_of(found)
    assert {"coulomb_friction", "position_late"} <= {f.name for f in found.findings}
    (late_s,) = (n for f in found.findings for n in f.numbers if n.name == "~late.position_m")
    assert late_s.value == pytest.approx(LATE * 1e-3, abs=3e-4)
    assert late_s.low < LATE * 1e-3 < late_s.high
    assert np.isclose(numbers["mass_kg"], 3.1, rtol=0.02)
    by = f"position_m late by {1e3 * late_s.value:.3g} ms"
    assert by in sentence(found)
    told = "what runs or tunes on that file knows nothing of it"
    html = write_html(build_diagnosis_page(found, late))
    assert told in html
    assert told in " ".join(format_terminal(report_diagnosis(found)).split())
    assert "plant.yaml has all of it" not in html
    assert "jumps where a window begins anew" in html


# --- play before the position sensor -------------------------------------------------------------

PLAY_M = 0.25e-3
BELT_KG, BELT_DAMPING = 2.4, 31.0


def test_a_reading_that_moves_is_pushed_and_one_that_rests_keeps_its_side():
    """Without forces a mass goes on at its speed; its reading is half of the play behind."""
    p = parameters_of(
        {
            "actuator": 1.0,
            "mass_kg": 10.0,
            "damping_n_s_per_m": 1e-6,
            "stiffness_n_per_m": 0.0,
            "encoder_backlash.width_m": PLAY_M,
        }
    )
    samples, begins, rests = 300, 100, 5
    still = np.full(samples, p.atmospheric_pressure_pa)
    force_n = np.full(samples, 20.0)
    free = drive_mechanics(p, still, 1e-3, force_n=force_n)
    assert free.position_m[rests] == 0.0 < free.true_position_m[rests] < 0.5 * PLAY_M
    resting = Restarts(np.array([rests]), np.zeros(1), np.zeros(1))
    kept = drive_mechanics(p, still, 1e-3, force_n=force_n, restarts=resting)
    assert kept.true_position_m == pytest.approx(free.true_position_m, abs=1e-12)
    pushed = Restarts(np.array([begins]), np.array([0.3]), np.array([-0.7]))
    driven = drive_mechanics(p, still, 1e-3, force_n=0.0 * force_n, restarts=pushed)
    way_m = 0.3 - 0.7e-3 * np.arange(samples - begins)
    assert driven.position_m[begins:] == pytest.approx(way_m, abs=1e-6)
    assert driven.true_position_m[begins:] == pytest.approx(way_m - 0.5 * PLAY_M, abs=1e-6)


def drive_belt(seed: int, width_m: float = PLAY_M) -> Record:
    """Return 10 s at 200 Hz of a carriage on a belt: means of 10 samples, which hide the noise.

    The carriage's linear equation is solved exactly from sample to sample.
    """
    random, period_s, hz = np.random.default_rng(seed), 5e-4, random_tones(seed)
    t_s = np.arange(0.0, 10.0, period_s)
    wanted_m = (1.0 - np.exp(-t_s)) * sum(size * np.sin(2.0 * np.pi * f * t_s) for size, f in hz)
    kept = exp(-BELT_DAMPING / BELT_KG * period_s)
    x = v = shown = 0.0
    rows = np.empty((2, len(t_s)))
    for k, goal_m in enumerate(wanted_m):
        force_n = 900.0 * (goal_m - x) - 25.0 * v
        rows[:, k] = shown, force_n
        end = force_n / BELT_DAMPING
        x += end * period_s + (v - end) * (1.0 - kept) * BELT_KG / BELT_DAMPING
        v = end + (v - end) * kept
        shown = min(max(shown, x - 0.5 * width_m), x + 0.5 * width_m)
    rows += random.normal(0.0, [[2e-6], [0.12]], rows.shape)
    position_m, force_n = rows.reshape(2, -1, 10).mean(axis=2)
    return Record(f"belt {seed}", t_s[9::10], position_m=position_m, force_n=force_n)


def random_tones(seed: int) -> list[tuple[float, float]]:
    random = np.random.default_rng(1000 + seed)
    return [*zip(random.uniform(6e-3, 20e-3, 5), random.uniform(0.2, 2.2, 5), strict=True)]


def diagnose_belt() -> Diagnosis:
    records = [drive_belt(seed) for seed in (1, 2, 3, 4)]
    plant = axis_plant(2.0 * BELT_KG, 2.0 * BELT_DAMPING)
    asked = ask_only(
        "encoder", "late", "coulomb_friction", "presliding", of=list_asked(records, plant)
    )
    return diagnose(records[:2], records[2:], plant, without=asked)


def test_play_has_its_place_where_the_mass_is_judged_in_windows():
    found = diagnose_belt()
    first = found.findings[0]
    assert (first.name, first.level) == ("encoder_backlash", "place")
    assert max(found.evidence.left_over_noise.values()) > 3.0  # so no name is sure
    values = numbers_of(found)
    assert values["encoder_backlash.width_m"] == pytest.approx(PLAY_M, rel=0.05)
    assert values["mass_kg"] == pytest.approx(BELT_KG, rel=0.01)
    assert values["damping_n_s_per_m"] == pytest.approx(BELT_DAMPING, rel=0.03)


# --- the state in which a window begins is no missing effect -------------------------------------

T_S = np.arange(0.0, 8.0, 1e-3)


def move(mass_kg: float, damping_n_s_per_m: float, seed: int) -> Record:
    """Return a linear axis that quick and slow forces move; its encoder has steps of 1 um."""

    def force_n(t: float) -> float:
        return float(25.0 * np.sin(9.0 * t + seed) + 20.0 * np.sin(29.0 * t) + 9.0 * np.sin(41 * t))

    def rates(t: float, y: np.ndarray) -> list[float]:
        return [y[1], (force_n(t) - damping_n_s_per_m * y[1]) / mass_kg]

    found = solve_ivp(rates, (0.0, T_S[-1]), [0.0, 0.0], "DOP853", T_S, rtol=1e-9, atol=1e-12)
    rounded_m = 1e-6 * np.round(1e6 * found.y[0])
    return Record(f"run {seed}", T_S, position_m=rounded_m, force_n=np.array([*map(force_n, T_S)]))


def test_where_windows_begin_the_speed_of_a_quick_motion_is_not_late():
    position_m = 5e-3 * np.sin(60.0 * T_S)
    rounded_m = 1e-6 * np.round(1e6 * position_m)
    found = find_starts(rounded_m, 1e-3, T_S)
    inside = slice(100, -100)
    off = found["speed"] - 0.3 * np.cos(60.0 * T_S)
    assert np.sqrt(np.mean(off[inside] ** 2)) < 1e-3 * 0.3


def test_a_still_axis_is_smoothed_over_the_whole_width():
    chance = np.random.default_rng(4)
    position_m = chance.normal(0.0, 1e-5, len(T_S))
    found = find_starts(position_m, 1e-3, T_S)
    assert np.std(found["speed"][100:-100]) < 3e-3


@pytest.mark.long
def test_of_an_exact_axis_nothing_is_missing_and_its_numbers_lie_in_their_intervals():
    fit, judge, plant = move(6.5, 45.0, 1), move(6.5, 45.0, 2), axis_plant(5.0, 40.0)
    asked = ask_only("friction", "late", "clock", "creep", "encoder", of=list_asked([fit], plant))
    found = diagnose([fit], [judge], plant, without=asked)
    assert not [f.name for f in found.findings if f.level == "name"]
    assert found.evidence is not None
    assert found.evidence.gap["recalibrated"]["position_m"] < 1e-5
    numbers = build_diagnosis_document(found)["recalibrated"]
    # Between samples the model's force is a straight line: that costs less than a thousandth.
    for name, true in (("mass_kg", 6.5), ("damping_n_s_per_m", 45.0)):
        low, high = numbers[name]["ci90"]
        assert low - 1e-3 * true < true < high + 1e-3 * true, name


def slow_axis(mass_kg):
    """Return a slow motion, and the force that it takes: of an axis with cogging mostly friction.

    A loop that chatters adds 6 N. Without a mass the force is what a crank feels.
    """
    t_s, x, v, a = np.arange(0.0, 20.0, 1e-3), 0.0, 0.0, 0.0
    for hz, amplitude_m in ((0.11, 0.04), (0.43, 0.012), (0.9, 0.005), (1.7, 0.002)):
        w = 2.0 * np.pi * hz
        x, v = x + amplitude_m * np.sin(w * t_s), v + amplitude_m * w * np.cos(w * t_s)
        a -= amplitude_m * w**2 * np.sin(w * t_s)
    force_n = mass_kg * a + 18.0 * v + 9.0 * np.sign(v) + 4.5 * np.sin(2.0 * np.pi * x / 0.024)
    force_n += np.random.default_rng(2).normal(0.0, 6.0, len(t_s))
    return Record("slow", t_s, position_m=x, force_n=force_n)


def test_a_slow_axis_of_which_friction_takes_most_is_moved_by_its_force_all_the_same():
    assert judge_motion([slow_axis(6.2)], "direct", 1e-3) == (False, True)
    assert judge_motion([slow_axis(0.0)], "direct", 1e-3) == (True, True)


def move_in_a_loop() -> Record:
    """Return an axis in a position loop, which cogs by 4.5 N, and sticks by 5.4 N more at rest."""
    period_s, parts, mass_kg = 1e-3, 10, 6.2
    t_s = np.arange(0.0, 10.0, period_s)
    wanted_m = 0.04 * np.sin(2.6 * t_s) + 0.012 * np.sin(11.0 * t_s) + 0.002 * np.sin(43.0 * t_s)
    wanted_m *= np.minimum(t_s, 1.0) ** 2
    noise = np.random.default_rng(4).normal(0.0, 0.5, len(t_s))
    x, v, summed, before, speed, step_s = 0.0, 0.0, 0.0, 0.0, 0.0, period_s / parts
    read_m, force_n = np.zeros((2, len(t_s)))
    for k in range(len(t_s)):
        read_m[k] = round(x / 1e-6) * 1e-6
        speed += 0.2 * ((read_m[k] - before) / period_s - speed)
        before, off = read_m[k], wanted_m[k] - read_m[k]
        summed += off * period_s
        force_n[k] = 9000.0 * off + 30000.0 * summed - 260.0 * speed + noise[k]
        for _ in range(parts):
            net = force_n[k] - 4.5 * sin(2.0 * pi * x / 0.024 + 0.7) - 18.0 * v
            pushed = v + step_s / mass_kg * net
            held = step_s / mass_kg * 9.0 * (1.0 + 0.6 * exp(-((v / 0.006) ** 2)))
            v = copysign(max(abs(pushed) - held, 0.0), pushed)
            x += v * step_s
    return Record("loop", t_s, position_m=read_m, force_n=force_n)


def test_cogging_and_stiction_of_an_axis_in_its_loop_are_found_with_their_numbers():
    plant = axis_plant(6.0, 20.0, coulomb_friction={"force_n": 9.0})
    asked = "force~wave", "stribeck", "viscous_asymmetry", "spring_hysteresis"
    found = diagnose([move_in_a_loop()], [], plant, without=ask_only(*asked))
    assert {f.name for f in found.findings} == {"force~wave(position)", "stribeck"}
    numbers = numbers_of(found)
    assert numbers["stribeck.rise"] == pytest.approx(0.6, abs=0.05)
    assert numbers["force_term.inner"] == pytest.approx(0.024, rel=0.01)


def test_a_jump_of_the_encoder_is_no_noise_where_windows_begin():
    axis = slow_axis(6.2)
    jumped = np.asarray(axis.position_m) + 0.01 * (axis.t_s > 12.0)
    assert find_starts(jumped, 1e-3, axis.t_s)["speed_error"].max() < 1e-4
