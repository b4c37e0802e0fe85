"""Differences between repeated runs are not an effect: repeatability limits the diagnosis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from support.made_records import COUNT_M, PERIOD_S, all_but, command_v, measured

from pamctl.diagnose import Diagnosis, Record, Verdict, diagnose, record_of, summary
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.repeatability import find_repeats, measure_repeatability
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.plant.drive import drive_coupled
from pamctl.plant.flat import parameters_of
from pamctl.plant.model import PlantSettings

GOLDEN = Path(__file__).parents[2] / "golden"
DEAD_BAND = {"valve_deadband__fill_width_v": 0.25, "valve_deadband__exhaust_width_v": 0.2}


def restless(program: str, seed: int, **hidden: float) -> Record:
    """A run whose pressure drifts by 1.2 kPa after the rest, which no model explains."""
    record = measured(program, seed, **hidden)
    random = np.random.default_rng(100 + seed)
    kept = np.exp(-PERIOD_S / 0.1)
    wander = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], random.normal(size=len(record)))
    awake = np.arange(len(record)) > record.rest_samples
    return replace(record, pressure_pa=record["pressure_pa"] + 1.2e3 * wander * awake)


def found(*, again: bool, **hidden: float) -> Diagnosis:
    """Diagnose a restless rig from one run or two runs of the same commands."""
    train = [restless("fit", seed, **hidden) for seed in ((1, 3) if again else (1,))]
    held = [restless("judge", 2, **hidden)]
    few = all_but("valve_deadband")
    return diagnose(train, held, PlantSettings(), without=few)


def test_two_runs_of_the_same_commands_are_repeats_and_one_run_in_two_lists_is_not() -> None:
    one, other = measured("fit", 1), measured("fit", 3)
    (repeat,) = find_repeats([one, other])
    assert (repeat.one, repeat.other, repeat.length) == (0, 1, len(one))
    assert find_repeats([one, one]) == ()
    assert find_repeats([one, measured("judge", 2)]) == ()


def test_periods_with_the_same_past_are_repeats() -> None:
    command = np.where(np.arange(12_000) // 500 % 2, -5.0, 5.0)
    record = Record("squares", np.arange(12_000) * 1e-3, valve_v=command)
    (repeat,) = find_repeats([record])
    assert (repeat.again - repeat.start) % 1000 == 0
    assert repeat.start >= 3000
    assert repeat.length >= 7000


@pytest.mark.long
def test_a_drifting_rig_with_repeated_runs_is_not_a_discrepancy() -> None:
    alone, repeated = found(again=False), found(again=True)
    assert alone.verdict is Verdict.NONE_KNOWN
    assert build_diagnosis_document(alone)["limits"]["pressure"]["decided_by"] == "self-simulation"
    assert repeated.verdict in (Verdict.NO_DISCREPANCY, Verdict.MISCALIBRATED)
    limit = build_diagnosis_document(repeated)["limits"]["pressure"]
    assert limit["decided_by"] == "repeatability"
    assert 2.0 < limit["limit_over_floor"] < 8.0
    assert "the rig does not repeat itself any better" in summary(repeated)


def test_an_effect_is_named_on_a_rig_that_repeats_itself_badly() -> None:
    repeated = found(again=True, **DEAD_BAND)
    assert repeated.verdict is Verdict.NAMED
    assert [s.effect.name for s in repeated.standings] == ["valve_deadband"]


def looped(seed: int, hand_v: float = 0.005, wander_pa: float = 0.0, **hidden: float) -> Record:
    """A run in closed loop: the reference is the same, the command differs a little each time."""
    truth = parameters_of({name.replace("__", "."): value for name, value in hidden.items()})
    random = np.random.default_rng(seed)
    demand_v = command_v("fit")
    own_v = lfilter([0.1], [1.0, -0.9], random.normal(0.0, 4.0 * hand_v, len(demand_v)))
    command = np.clip(demand_v + own_v * (np.arange(len(demand_v)) > 600), -5.0, 5.0)
    driven = drive_coupled(truth, command, PERIOD_S, steps=8)
    kept = np.exp(-PERIOD_S / 0.1)
    wander = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], random.normal(size=len(command)))
    wander *= np.arange(len(command)) > 600
    return Record(
        f"looped-{seed}",
        np.arange(len(command)) * PERIOD_S,
        valve_v=command,
        pressure_pa=driven.pressure_pa
        + random.normal(0.0, 300.0, len(wander))
        + wander_pa * wander,
        position_m=np.floor(driven.position_m / COUNT_M + random.uniform()) * COUNT_M,
        reference_m=1e-3 * demand_v,
    )


def spread_over_noise(**loop: float) -> float:
    """How far the pressure block of two looped runs is from repeating itself, in deviations."""
    records = [looped(seed, **loop) for seed in (1, 2)]
    evidence = prepare_evidence(records, [], PlantSettings())
    return measure_repeatability(evidence.train["pressure"], PlantSettings(), evidence.repeated).rms


def test_runs_with_the_same_reference_are_repeats_though_their_commands_differ() -> None:
    one, other = looped(1), looped(2)
    (repeat,) = find_repeats([one, other])
    assert repeat.demand == "reference_m"
    assert repeat.length == len(one)
    assert find_repeats([replace(one, reference_m=None), replace(other, reference_m=None)]) == ()


def test_equal_commands_come_before_equal_references() -> None:
    record = looped(1)
    (repeat,) = find_repeats([record, replace(looped(2), valve_v=record.valve_v)])
    assert repeat.demand == "valve_v"


def test_periods_of_a_reference_are_repeats() -> None:
    t_s = np.arange(12_000) * 1e-3
    hand_v = np.random.default_rng(3).normal(0.0, 0.01, len(t_s))
    wanted_m = 1e-3 * np.sin(2.0 * np.pi * t_s)
    record = Record("sine", t_s, valve_v=np.sin(6.3 * t_s) + hand_v, reference_m=wanted_m)
    (repeat,) = find_repeats([record])
    assert repeat.demand == "reference_m"
    assert (repeat.again - repeat.start) % 1000 == 0
    assert repeat.length >= 7000


def test_in_closed_loop_a_missing_effect_is_not_counted_as_poor_repeatability() -> None:
    # Without the dead band the model is 60 deviations off, in both runs alike.
    assert spread_over_noise(**DEAD_BAND) < 1.3


def test_differences_of_the_rig_in_closed_loop_are_counted() -> None:
    assert 3.0 < spread_over_noise(wander_pa=1.2e3) < 5.0


def test_a_hunting_loop_gives_no_repeatability() -> None:
    assert spread_over_noise(hand_v=0.3, **DEAD_BAND) < 3.0


def test_a_log_of_a_closed_loop_holds_its_reference() -> None:
    record = record_of(GOLDEN / "qsmc.mcap")
    assert record.reference_m is not None
    assert len(record.reference_m) == len(record)
    assert len(record.cut_samples(5, 9, "part").reference_m) == 4
