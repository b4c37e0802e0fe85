"""The noise of a measured force, passed through a model, is no missing effect."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from support.made_records import ask_only, axis_plant, list_asked, names_of, numbers_of

from pamctl.diagnose import Record, Verdict, diagnose, sentence
from pamctl.diagnose.evidence.input_noise import draw_noise, estimate_sizes, find_input_error2
from pamctl.diagnose.evidence.weigh import prepare_weigher
from pamctl.diagnose.report.finding_words import list_faults

MASS_KG, DAMPING, STIFFNESS, PERIOD_S, STEPS = 8.0, 40.0, 2500.0, 2e-3, 20
T_S = np.arange(0.0, 16.0, PERIOD_S)
WHITE_N = 0.2
PLANT = axis_plant(MASS_KG, 37.0, 2450.0).model_copy(update={"known": ["mass_kg"]})


def triangle(period_s: float) -> np.ndarray:
    phase = (T_S / period_s) % 1.0
    return 100.0 * (1.0 - 4.0 * np.abs((phase + 0.25) % 1.0 - 0.5))


def tones(seed: int) -> np.ndarray:
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 5)
    hz = (0.31, 0.83, 1.7, 3.1, 6.3)
    return 25.0 * sum(np.sin(2.0 * np.pi * f * T_S + p) for f, p in zip(hz, phases, strict=True))


def wander(seed: int) -> np.ndarray:
    """Return noise that is about four times as large at slow scales as at the finest."""
    white = np.random.default_rng(seed).normal(0.0, WHITE_N, len(T_S))
    return np.asarray(white + lfilter([0.4], [1.0, -0.85], white))


def move(name: str, force_n: np.ndarray, noise_n: np.ndarray, dry_n: float = 0.0) -> Record:
    """Return what a mass on a spring shows whose force is read with this noise."""
    x, v, step_s, shown_m = 0.0, 0.0, PERIOD_S / STEPS, np.empty(len(force_n))
    after_n = np.append(force_n[1:], force_n[-1])
    for k in range(len(force_n)):
        shown_m[k] = x
        for part in range(STEPS):
            now_n = force_n[k] + (part + 0.5) / STEPS * (after_n[k] - force_n[k])
            free = v + step_s / MASS_KG * (now_n - STIFFNESS * x - DAMPING * v)
            held = min(abs(free), step_s / MASS_KG * dry_n)
            v = free - np.copysign(held, free)
            x += step_s * v
    shown_m += np.random.default_rng(len(name)).normal(0.0, 2e-6, len(shown_m))
    return Record(name, T_S, force_n=force_n + noise_n, position_m=shown_m)


def move_thrice(dry_n: float = 0.0) -> list[Record]:
    forces = {"quick": tones(1), "slow": triangle(8.0), "judge": triangle(5.0)}
    noises = map(wander, range(3))
    return [move(*each, noise, dry_n) for each, noise in zip(forces.items(), noises, strict=True)]


def test_of_noise_the_size_is_found_at_each_time_scale_though_a_force_moves():
    sizes = estimate_sizes([tones(1) + wander(1), triangle(8.0) + wander(2)], 256)
    assert sizes[0] == pytest.approx(WHITE_N, rel=0.35)
    assert 2.0 * WHITE_N < sizes[-1] <= 4.0 * sizes[0]
    drawn = draw_noise(len(T_S), sizes, np.random.default_rng(0))
    again = estimate_sizes([drawn], 256)
    assert again[:5] == pytest.approx(sizes[:5], rel=0.35)


def test_a_motion_that_is_in_all_records_is_not_taken_for_noise():
    white = np.random.default_rng(3).normal(0.0, WHITE_N, len(T_S))
    assert estimate_sizes([tones(1) + white], 256).max() < 1.5 * WHITE_N


def test_stated_noise_is_that_of_the_finest_scale():
    force_n = [triangle(8.0) + wander(2)]
    sizes = estimate_sizes(force_n, 256)
    assert estimate_sizes(force_n, 256, 0.05) == pytest.approx(sizes * 0.05 / sizes[0])


def test_what_the_noise_of_the_force_leaves_is_no_missing_effect():
    *fit, judge = move_thrice()
    asked = ask_only("coulomb_friction", "cubic_stiffness", of=list_asked(fit, PLANT))
    found = diagnose(fit, [judge], PLANT, without=asked)
    assert found.verdict in (Verdict.NO_DISCREPANCY, Verdict.MISCALIBRATED)
    assert not found.findings
    assert found.evidence is not None
    assert found.evidence.gap["recalibrated"]["position_m"] > 6e-6
    assert found.evidence.left_over_noise["position_m"] < 2.0
    assert found.evidence.sensor_rms["position_m"] < 4e-6
    assert "and of the measured force that drives the model" in sentence(found)


def test_of_slower_noise_than_is_counted_the_verdict_says_how_it_is_stated():
    def drift(seed: int) -> np.ndarray:
        white = np.random.default_rng(seed).normal(0.0, 1.0, len(T_S))
        return np.asarray(0.3 * WHITE_N * white + lfilter([0.15], [1.0, -0.99], white))

    forces = {"quick": tones(1), "slow": triangle(8.0), "judge": triangle(5.0)}
    *fit, judge = [
        move(name, force_n, drift(seed)) for seed, (name, force_n) in enumerate(forces.items())
    ]
    asked = ask_only("coulomb_friction", of=list_asked(fit, PLANT))
    found = diagnose(fit, [judge], PLANT, without=asked)
    assert found.evidence is not None
    assert found.evidence.left_over_noise["position_m"] > 3.0
    (enough_n,) = found.evidence.enough_noise.values()
    assert f"if it may, `--noise force_n={enough_n:.2g}` states it" in sentence(found)
    again = diagnose(fit, [judge], PLANT, without=asked, noise={"force_n": enough_n})
    assert again.evidence is not None
    assert again.evidence.left_over_noise["position_m"] < 3.0


def test_numbers_are_known_less_well_where_the_stated_noise_may_be_slow():
    def drift(seed: int) -> np.ndarray:
        white = np.random.default_rng(seed).normal(0.0, 1.0, len(T_S))
        return np.asarray(0.3 * WHITE_N * white + lfilter([0.05], [1.0, -0.995], white))

    fit = [move("quick", tones(1), drift(0)), move("slow", triangle(8.0), drift(1))]
    asked = ask_only("force~curve(time)", of=list_asked(fit, PLANT))
    widths = []
    for stated in {}, {"force_n": 0.7}:
        found = diagnose(fit, [], PLANT, without=asked, noise=stated)
        assert not found.findings
        damping, stiffness = found.recalibrated[:2]
        assert damping.low < DAMPING < damping.high
        assert stiffness.low < STIFFNESS < stiffness.high
        widths.append(stiffness.high - stiffness.low)
    assert widths[1] > 0.9 * widths[0], "what the noise leaves may be alike in all stretches"


def test_of_a_set_that_slow_noise_of_the_force_may_be_the_title_says_so():
    drifts = [0.5 * np.sin(2.0 * np.pi * f * T_S) for f in (0.021, 0.017)]
    fit = [move("quick", tones(1), drifts[0]), move("slow", triangle(8.0), drifts[1])]
    asked = ask_only("force~curve(time)", "encoder~curve(time)", of=list_asked(fit, PLANT))
    found = diagnose(fit, [], PLANT, without=asked)
    assert found.verdict == Verdict.AMBIGUOUS
    assert found.evidence is not None
    assert "slow noise" not in sentence(found)
    loud = {c: 10.0 * rms for c, rms in found.evidence.noise_rms.items()}
    evidence = replace(found.evidence, enough_noise={"force_n": 0.4}, noise_rms=loud)
    may_be = replace(found, evidence=evidence)
    assert "over time, if it is not slow noise of the measured force." in sentence(may_be)
    assert "if it may, `--noise force_n=0.4` states it." in sentence(may_be)


def test_a_real_friction_is_found_beside_the_noise_of_the_force():
    *fit, judge = move_thrice(dry_n=1.0)
    asked = ask_only("coulomb_friction", "cubic_stiffness", of=list_asked(fit, PLANT))
    found = diagnose(fit, [judge], PLANT, without=asked)
    assert names_of(found) == ["coulomb_friction"]
    assert numbers_of(found)["coulomb_friction.force_n"] == pytest.approx(1.0, abs=0.1)
    assert found.evidence is not None
    assert found.evidence.left_over_noise["position_m"] < 2.0


def test_a_force_that_really_jumps_from_sample_to_sample_is_no_noise():
    force_n = np.random.default_rng(8).normal(0.0, 60.0, len(T_S))
    record = move("jumps", force_n, np.zeros(len(T_S)))
    weigher, start = prepare_weigher([record], (), PLANT)
    m = weigher.settle(start)
    (error2,) = find_input_error2(weigher, m, {})
    assert error2 <= weigher.like.mean_squares(m.d)[0]
    assert error2 < 1e-3 * np.var(np.asarray(record.position_m))


def test_what_runs_from_its_command_has_no_noise_of_an_input():
    axis = move("axis", tones(1), wander(1))
    weigher, _ = prepare_weigher([axis], (), PLANT)
    assert weigher.train.drivers == ("force_n",)
    muscle = axis_plant(MASS_KG, DAMPING, STIFFNESS).model_copy(update={"actuator": "muscle"})
    command = Record("muscle", T_S, valve_v=tones(1), position_m=axis.position_m)
    driven, _ = prepare_weigher([command], (), muscle)
    assert driven.train.drivers == ()


def test_a_scale_is_said_of_the_force_or_of_the_position():
    *fit, judge = [
        Record(r.name, r.t_s, force_n=np.asarray(r.force_n) / 1.03, position_m=r.position_m)
        for r in move_thrice()
    ]
    asked = ask_only("encoder", "creep", "cubic_stiffness", of=list_asked(fit, PLANT))
    found = diagnose(fit, [judge], PLANT, without=asked)
    (fault,) = list_faults(found)
    assert (fault.kind, fault.number) == ("scale", "position_m")
    assert fault.cannot_be_told_from == ["scale of force_n"]
    assert fault.value == pytest.approx(1.03, abs=2e-3)
    assert "the position is 3" in fault.text
    assert "too large for the force: the scale of one is wrong" in sentence(found)
    again = diagnose(fit, [judge], found.plant, without=asked)
    assert not again.findings
    assert again.verdict is Verdict.NO_DISCREPANCY
