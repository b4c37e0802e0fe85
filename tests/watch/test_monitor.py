"""The monitor on simulated runs: quiet on a faultless rig, loud on a changed one."""

import os
import signal
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.processes.daemons import NOT_HOMED, TRACKING, daemon

from pamctl.log import read
from pamctl.log.measured_signals import Signals
from pamctl.offline.closed_loop import simulate_run
from pamctl.settings.resolve import resolve
from pamctl.signals import Phase
from pamctl.watch.judge_window import (
    ALARM,
    ALLOWANCE,
    MECHANICS,
    MOST_OF_ONE,
    PRESSURE,
    MisfitSums,
    WindowMisfit,
)
from pamctl.watch.watch_run import LEARN_S, RunWatch

PLANT = "paper"
LESS_FRICTION = "plant.parameters.kinetic_friction_per_m=50"


@cache
def simulate_signals(experiment: str, seconds: float, *overrides: str) -> Signals:
    settings = resolve(
        experiment=experiment, plant=PLANT, overrides=overrides, seed=3, duration_s=seconds
    )
    run = simulate_run(settings)
    return Signals(
        t_s=run.t_s,
        dt_s=np.diff(run.t_s, prepend=-1e-3),
        valve_v=run["valve_v"],
        pressure_pa=run["pressure_pa"],
        position_m=run["position_m"],
        force_n=None,
        missed=np.zeros(len(run.t_s), dtype=np.int64),
        phase=np.full(len(run.t_s), int(Phase.TRACK)),
        held_v=-5.0,
    )


def feed(watch: RunWatch, measured: Signals, start_s: float) -> None:
    """A second at a time, as the process does."""
    for first in range(0, len(measured), 1000):
        watch.take(measured[first : first + 1000], start_s + first * 1e-3)


@pytest.fixture
def watch() -> RunWatch:
    """A monitor that has seen twelve seconds of the faultless rig."""
    watch = RunWatch(resolve(plant=PLANT).plant)
    feed(watch, simulate_signals("tracking-2", 12.0), 0.0)
    return watch


def test_a_faultless_rig_fits_and_raises_no_alarm(watch):
    assert watch.windows >= 10
    assert {name: report.state for name, report in watch.blocks.items()} == {
        PRESSURE: "fits",
        MECHANICS: "fits",
    }
    assert all(report.alarm is None for report in watch.blocks.values())


@pytest.mark.parametrize(
    ("change", "block", "other"),
    [
        ("plant.parameters.valve_gain_m2_per_v=0.93e-6", PRESSURE, MECHANICS),
        (LESS_FRICTION, MECHANICS, PRESSURE),
    ],
)
def test_a_change_is_noticed_in_its_block_and_not_in_the_other(watch, change, block, other):
    watch.begin_run()
    feed(watch, simulate_signals("tracking-2", 8.0, change), 100.0)
    alarm = watch.blocks[block].alarm
    assert alarm is not None
    assert 100.0 <= alarm.since_s < 106.0
    assert alarm.over_floor > 1.5
    assert watch.blocks[other].alarm is None


def test_a_muscle_that_stands_still_shows_nothing(watch):
    at_rest = simulate_signals("tracking-2", 12.0)[:200]
    still = replace(
        at_rest,
        t_s=np.arange(9000) * 1e-3,
        dt_s=np.full(9000, 1e-3),
        valve_v=np.full(9000, -5.0),
        pressure_pa=101.3e3 + np.random.default_rng(1).normal(0.0, 300.0, 9000),
        position_m=np.zeros(9000),
        missed=np.zeros(9000, dtype=np.int64),
        phase=np.full(9000, int(Phase.OPEN_LOOP)),
    )
    watch.begin_run()
    feed(watch, still, 200.0)
    assert {r.state for r in watch.blocks.values()} == {"cannot tell"}


def test_homing_and_gaps_are_left_out():
    measured = simulate_signals("tracking-2", 12.0)
    watch = RunWatch(resolve(plant=PLANT).plant)
    feed(watch, replace(measured, phase=np.full(len(measured), int(Phase.HOMING))), 0.0)
    assert watch.windows == 0
    feed(watch, measured, 50.0)
    first = watch.windows
    assert first > 0
    feed(watch, measured[:1400], 50.0 + LEARN_S + 10.0)  # too short for a window by itself
    assert watch.windows == first


def test_one_window_is_no_alarm_and_an_alarm_ends():
    sums = MisfitSums()
    off = WindowMisfit(PRESSURE, "swing", True, 900.0, 100.0, 2.0, 0.05)
    quiet = WindowMisfit(PRESSURE, "swing", True, 100.0, 100.0, -0.2, 0.05)
    sums.take(off, 10.0)
    assert sums.find_alarm(PRESSURE) is None
    needed = int(np.ceil(ALARM / (MOST_OF_ONE - ALLOWANCE)))
    for k in range(1, needed + 1):
        sums.take(off, 10.0 + k)
    alarm = sums.find_alarm(PRESSURE)
    assert alarm is not None
    assert (alarm.since_s, round(alarm.over_floor)) == (10.0, 9)
    assert sums.find_alarm(MECHANICS) is None
    for k in range(20):
        sums.take(quiet, 50.0 + k)
    assert sums.find_alarm(PRESSURE) is None


def test_a_rest_does_not_hide_what_the_motions_show():
    sums = MisfitSums()
    off = WindowMisfit(PRESSURE, "swing", True, 900.0, 100.0, 2.0, 0.05)
    rest = WindowMisfit(PRESSURE, "rest", False, 100.0, 100.0, -0.2, 0.05)
    for k in range(4):
        sums.take(off, 10.0 * k)
        for j in range(8):
            sums.take(rest, 10.0 * k + j + 1.0)
    assert sums.find_alarm(PRESSURE) is not None


@pytest.mark.long
def test_beside_a_daemon_it_follows_the_run_and_its_death_harms_nothing(tmp_path):
    long = {**TRACKING, "cycles": 30}
    with daemon(
        tmp_path, "mon", NOT_HOMED, options=["--monitor", "--monitor-plant", "paper"]
    ) as up:
        log = Path(up.ask("start", experiment=long, name="watched")["log"])
        status = up.wait_until(lambda s: bool(s["monitor"]["blocks"]) or not s["run"])
        assert {b["block"] for b in status["monitor"]["blocks"]} == {PRESSURE, MECHANICS}
        os.kill(status["pids"]["monitor"], signal.SIGKILL)
        status = up.wait_until(lambda s: not s["monitor"]["alive"])
        assert "ended" in status["monitor"]["sentence"]
        assert status["run"] == "watched"
        up.ask("stop")
        up.wait_until(lambda s: s["run"] is None)
        assert status["fault"] == ""
    assert len(read(log)) > 1000
