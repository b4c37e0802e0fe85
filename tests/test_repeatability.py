"""A real rig never reaches a simulated floor: what it does differently each time is no effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_records import PERIOD_S, measured
from scipy.signal import lfilter
from test_diagnose import all_but

from pamctl.diagnose import Diagnosis, Record, Verdict, diagnose, summary
from pamctl.diagnose.document import document
from pamctl.diagnose.repeats import repeats
from pamctl.plant.model import PlantSettings

DEAD_BAND = {"valve_deadband__fill_width_v": 0.25, "valve_deadband__exhaust_width_v": 0.2}


def restless(program: str, seed: int, **hidden: float) -> Record:
    """A run whose pressure wanders by 1.2 kPa as soon as it is not at rest, in no model's way."""
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


def test_two_runs_of_the_same_commands_are_a_repeat_and_one_run_cut_in_two_is_none() -> None:
    one, other = measured("fit", 1), measured("fit", 3)
    (repeat,) = repeats([one, other])
    assert (repeat.one, repeat.other, repeat.length) == (0, 1, len(one))
    assert repeats([one, one]) == ()
    assert repeats([one, measured("judge", 2)]) == ()


def test_periods_are_repeats_once_their_past_is_the_same() -> None:
    command = np.where(np.arange(12_000) // 500 % 2, -5.0, 5.0)
    record = Record("squares", np.arange(12_000) * 1e-3, valve_v=command)
    (repeat,) = repeats([record])
    assert (repeat.again - repeat.start) % 1000 == 0
    assert repeat.start >= 3000
    assert repeat.length >= 7000


def test_a_restless_rig_is_not_blamed_where_its_runs_are_repeated() -> None:
    alone, repeated = found(again=False), found(again=True)
    assert alone.verdict is Verdict.NONE_KNOWN
    assert document(alone)["limits"]["pressure"]["decided_by"] == "self-simulation"
    assert repeated.verdict in (Verdict.NO_DISCREPANCY, Verdict.MISCALIBRATED)
    limit = document(repeated)["limits"]["pressure"]
    assert limit["decided_by"] == "repeatability"
    assert 2.0 < limit["limit_over_floor"] < 8.0
    assert "the rig does not repeat itself any better" in summary(repeated)


def test_an_effect_is_named_on_a_rig_that_repeats_itself_badly() -> None:
    repeated = found(again=True, **DEAD_BAND)
    assert repeated.verdict is Verdict.NAMED
    assert [s.effect.name for s in repeated.standings] == ["valve_deadband"]
