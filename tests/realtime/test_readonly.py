"""`pamctl run --readonly`: everything as in a run, but nothing moves."""

import json
import math

import numpy as np
import pytest
from support.command_line import run_pamctl
from support.runs import AO_STEP_V, Run, run, run_settings

from hal.faulty import FaultSettings
from pamctl.base.errors import ExitCode
from pamctl.log.reader import read
from pamctl.safety import PINNED, STROKE_LIMIT
from pamctl.signals import Phase

SAFE_OUTPUT_V = 1.0
BRIEF = ("experiment.approach_s=1.0", "rig.loop.stop_ramp_s=0.05")


@pytest.fixture(scope="module")
def looked_on() -> Run:
    settings = run_settings(
        *BRIEF, f"rig.safe_volts={SAFE_OUTPUT_V}", readonly=True, duration_s=3.0
    )
    return run(settings)


def test_nothing_but_the_safe_voltage_is_ever_written(looked_on):
    written = {record.outcome.applied_v for record in looked_on.journal.ticks}
    assert len(written) == 1
    assert written.pop() == pytest.approx(SAFE_OUTPUT_V, abs=AO_STEP_V / 2)
    true_m = [record.truth.true_position_m for record in looked_on.journal.ticks]
    assert max(map(abs, true_m)) < 3.2e-6


def test_the_law_computes_all_the_same_and_its_command_is_on_record(looked_on):
    tracking = looked_on.journal.phase(Phase.TRACK) + looked_on.journal.phase(Phase.APPROACH)
    assert len(tracking) == 3000
    # 6.4 mm from its reference at the end of the approach: far beyond the limit of the error.
    assert max(abs(record.estimate.error_m) for record in tracking) > 6e-3
    commands = [record.command.command_v for record in tracking]
    assert all(map(math.isfinite, commands))
    assert max(commands) > 1.0


def test_every_tick_says_that_the_output_was_pinned_and_the_run_is_complete(looked_on):
    assert {record.decision.verdicts for record in looked_on.journal.ticks} == {PINNED}
    assert looked_on.ending.code == ExitCode.OK


def test_homing_takes_the_zeros_where_the_muscle_rests_without_filling_it(looked_on):
    homing = looked_on.journal.phase(Phase.HOMING)
    assert 200 < len(homing) < 400  # one vent's steady time: no fill, no second vent
    _, found = looked_on.journal.named("zeroed")
    assert found["sensor_zero_v"] == pytest.approx(0.215, abs=1e-3)


def test_a_rig_that_holds_its_pressure_is_not_taken_for_a_vented_one():
    """Where the safe voltage closes the valve, what is in the muscle stays in it."""
    settings = run_settings("rig.safe_volts=5.0", "rig.sim.sensor_zero_v=0.6", readonly=True)
    ran = run(settings)
    assert ran.ending.code == ExitCode.SAFETY_TRIP
    assert "check that the muscle is vented" in ran.ending.reason


def test_a_sensor_that_lies_still_trips():
    settings = run_settings(*BRIEF, "rig.homing.enabled=false", readonly=True, duration_s=1.0)
    ran = run(settings, FaultSettings(kind="encoder_jump", from_tick=500, size=-20_000))
    assert ran.ending.code == ExitCode.SAFETY_TRIP
    assert ran.journal.ticks[-1].decision.verdicts & STROKE_LIMIT


def test_an_open_loop_experiment_is_looked_on_too():
    ran = run(run_settings(experiment="square-2", readonly=True, duration_s=0.6))
    assert ran.ending.code == ExitCode.OK
    asked = {record.command.command_v for record in ran.journal.phase(Phase.OPEN_LOOP)}
    assert asked == {5.0, -5.0}
    assert len({record.outcome.applied_v for record in ran.journal.ticks}) == 1


def test_a_replay_of_a_readonly_run_comes_to_the_same_decisions(tmp_path):
    options = ["--readonly", "--fast", "--duration", "1", "--quiet", "--log", "run.mcap"]
    run_pamctl("run", *options, cwd=tmp_path).check_returncode()
    done = run_pamctl("replay", "run.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "equal" in done.stdout


def test_pamctl_run_readonly_says_so_and_its_log_does(tmp_path):
    command = ["run", "--readonly", "--fast", "--duration", "1"]
    done = run_pamctl(*command, "--json", "--log", "run.mcap", cwd=tmp_path)
    assert json.loads(done.stdout)["readonly"] is True
    log = read(tmp_path / "run.mcap")
    assert log.config["readonly"] is True
    assert np.unique(log["applied_v"]).tolist() == [0.0]
    assert np.unique(log["verdicts"]).tolist() == [PINNED]
    text = run_pamctl(*command, "--log", "again.mcap", cwd=tmp_path).stdout
    assert "nothing was tracked" in text
    assert "paper" not in text
