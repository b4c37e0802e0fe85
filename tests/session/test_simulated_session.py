"""A session on the simulated rig: the daemon's rules, whole logs, and the right motion."""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run_process
from support.processes.daemons import QUICK
from support.runs import COUNT_M

import pamctl
from pamctl.base.errors import Ending, ExitCode
from pamctl.daemon.in_process import InProcessLoop
from pamctl.daemon.rig_session import RigSession
from pamctl.daemon.shelf import Shelf
from pamctl.log import read
from pamctl.offline.closed_loop import simulate_run
from pamctl.offline.tick_replay import replay_log
from pamctl.runs.run_row import read_row
from pamctl.session.simulated_rig import simulate
from pamctl.settings.resolve import resolve
from pamctl.signals import Phase

SINE = pamctl.Sine(offset_mm=4, amplitude_mm=1, frequency_hz=2, cycles=2)
NOT_HOMED = "rig.homing.enabled=false"


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[pamctl.SimulatedRig]:
    with simulate(logs=tmp_path, overrides=QUICK) as made:
        yield made


def test_an_afternoon_of_positions_runs_marks_and_gains_replays_to_the_bit(rig):
    assert rig.state == "idle"
    rig.goto(4e-3, within_s=0.5)
    tick = rig.status()["tick"]
    assert rig.state == "ready"
    assert tick["reference_m"] == pytest.approx(4e-3)
    assert abs(tick["position_m"] - 4e-3) < 0.2e-3
    run = rig.run(SINE, name="first")
    assert run.ending == (ExitCode.OK, "the experiment is complete")
    assert rig.state == "ready"
    log = rig.start(SINE)
    seen = []
    for tick in rig.live(rate_hz=20):
        seen.append(tick["tick"])
        if len(seen) == 10:
            rig.mark("softer from here")
            rig.set(lambda_per_s=12, ramp_s=0.2)
    assert np.all(np.diff(seen) == 50)
    again = rig.wait()
    assert again.path == log
    ((at_s, text),) = again.marks
    assert text == "softer from here"
    assert again.t_s[0] < at_s < again.t_s[-1]
    assert [g["lambda_per_s"] for g in again.log.gains][-1] == rig.gains["lambda_per_s"] == 12
    for each in (run, again):
        assert replay_log(each.log).is_equal
    rig.start(SINE)
    rig._ask("stop")
    rig._link.sleep(0.05)
    assert rig.state == "stopping"


def test_a_motion_that_might_fill_the_disk_is_refused_before_it_begins(rig, monkeypatch):
    """One without an end needs room for ten minutes at its start, at 300 bytes a tick."""
    monkeypatch.setattr(Shelf, "free_bytes", (100 << 20) + 600 * 1000 * 300 - 1)
    with pytest.raises(pamctl.PamctlError, match=r"has 271 MiB left, this run may need 271; make"):
        rig.goto(4e-3)
    assert rig.run(SINE).ending == (ExitCode.OK, "the experiment is complete")


def test_the_motion_is_that_of_the_compiled_batch(tmp_path):
    """The batch is composed otherwise, and begins with the experiment at once."""
    quiet = [NOT_HOMED, "rig.sim.sensor_noise_v=0", "rig.sim.encoder_start_counts=1000.4"]
    tracking = pamctl.Tracking(
        offset_mm=8, amplitude_mm=3, transition_s=0.5, approach_s=1, settle_s=0.5, cycles=1
    )
    with simulate("paper-valve109", logs=tmp_path, overrides=quiet) as rig:
        run = rig.run(tracking)
    settings = resolve(plant="paper-valve109", overrides=quiet, fast=True)
    experiment = type(settings.experiment).model_validate(tracking.to_data())
    batch = simulate_run(settings.model_copy(update={"experiment": experiment}))
    assert batch.tripped_s is None
    ticks = len(batch.t_s)
    apart_m = np.abs(run["true_position_m"][:ticks] - batch["true_position_m"])
    tracked = run["phase"][:ticks] == Phase.TRACK
    # While it is parked the muscle's pressure has settled: the first steps of the encoder come
    # at other ticks, and the law answers them.
    assert apart_m[tracked].max() < 2 * COUNT_M
    assert np.ptp(batch["true_position_m"]) > 6e-3


def test_an_exception_in_the_block_stops_the_run_smoothly_and_its_log_is_whole(tmp_path):
    with pytest.raises(KeyboardInterrupt), simulate(logs=tmp_path, overrides=QUICK) as rig:
        log = rig.start(SINE)
        for tick in rig.live():
            if tick["reference_m"] > 3e-3:
                raise KeyboardInterrupt
    run = pamctl.Run.open(log)
    assert run.ending.reason == "the session ended"
    assert run["valve_v"][-1] == pytest.approx(-5.0, abs=0.1)
    assert replay_log(run.log).is_equal


def loop_of(rig: pamctl.SimulatedRig) -> InProcessLoop:
    session: RigSession = rig._link._session  # type: ignore[attr-defined]
    assert isinstance(session.carrier, InProcessLoop)
    return session.carrier


def test_ctrl_c_within_a_tick_is_obeyed_after_it(rig, monkeypatch):
    rig.goto(5e-3, within_s=0.5)
    before = rig.status()["tick"]["tick"]
    with monkeypatch.context() as pressed:
        pressed.setattr(loop_of(rig), "find_stop", lambda tick: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            rig.sleep(0.1)
    assert rig.status()["tick"]["tick"] == before + 1
    rig.sleep(0.1)
    assert rig.status()["tick"]["tick"] == before + 101


def test_ctrl_c_during_a_run_stops_it_and_leaves_the_log(tmp_path):
    program = f"""
import os, pathlib, signal, threading, time, pamctl
def press():
    while not list(pathlib.Path({str(tmp_path)!r}).glob("*.mcap")):
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)
with pamctl.simulate(logs={str(tmp_path)!r}, overrides={QUICK!r}) as rig:
    threading.Thread(target=press, daemon=True).start()
    rig.run(pamctl.Sine(offset_mm=10, amplitude_mm=1, frequency_hz=1, cycles=20_000))
"""
    command = [sys.executable, "-c", program]
    done = run_process(command)
    assert "KeyboardInterrupt" in done.stderr
    (log,) = tmp_path.glob("*.mcap")
    assert pamctl.Run.open(log).ending.reason in {"interrupted", "the session ended"}
    left = os.environ["PAMCTL_SHARED_MEMORY"]
    assert not list(Path(left).glob("*.ring"))


def test_what_is_refused_has_the_shells_line_and_code_and_changes_nothing(rig):
    before = rig.gains
    for wrong, line, code in (
        (lambda: rig.goto(0.2), "goto 200 mm lies outside the stroke", ExitCode.CHECK_FAILED),
        (lambda: rig.set(lamda_per_s=3), "did you mean 'lambda_per_s'", ExitCode.CHECK_FAILED),
        (lambda: rig.set(lambda_per_s=-3), "controller.lambda_per_s", ExitCode.CHECK_FAILED),
        (lambda: rig.mark("x"), "nothing is being logged", ExitCode.CHECK_FAILED),
        (lambda: rig.stop(), "nothing is running: the state is idle", ExitCode.CHECK_FAILED),
        (lambda: rig.run("sin"), "did you mean 'sine'", ExitCode.BAD_CONFIG),
        (lambda: rig.run(pamctl.Hold(position_mm=9)), "has no end", ExitCode.USAGE),
        (
            lambda: rig.run(pamctl.Sine(offset_mm=31, amplitude_mm=2, frequency_hz=1)),
            "a position of 33 mm", ExitCode.CHECK_FAILED,
        ),
        (lambda: rig.wait(), "no run was begun here", ExitCode.USAGE),
        (lambda: rig.ack(), "there is no fault", ExitCode.CHECK_FAILED),
    ):  # fmt: skip
        with pytest.raises(pamctl.PamctlError) as refused:
            wrong()
        assert line in str(refused.value)
        assert refused.value.exit_code == code, line
    assert rig.gains == before
    assert rig.state == "idle"


@pytest.mark.parametrize(
    ("options", "line", "code"),
    [
        ({"plant": "papr"}, "did you mean 'paper'", ExitCode.USAGE),
        ({"plant": {"parameters": {"stifness_n_per_m": 1.0}}}, "did you mean", ExitCode.BAD_CONFIG),
        ({"rig": "pci6221"}, "is not simulated; start `pamctl daemon`", ExitCode.USAGE),
        ({"overrides": ["rig.homing.fills=x"]}, "rig.homing.fills", ExitCode.BAD_CONFIG),
    ],
)
def test_settings_that_cannot_be_used_begin_nothing(options, line, code, tmp_path):
    with pytest.raises(pamctl.PamctlError) as refused:
        simulate(logs=tmp_path / "logs", **options)  # type: ignore[arg-type]
    assert line in str(refused.value)
    assert refused.value.exit_code == code
    assert not (tmp_path / "logs").exists()


def test_a_trip_names_its_reason_its_code_and_the_log_and_is_latched(tmp_path):
    limits = [*QUICK, NOT_HOMED, "rig.limits.stroke_high_mm=9"]
    steps = pamctl.Steps(steps=[{"valve_v": 5.0, "hold_s": 3.0}])
    with simulate(logs=tmp_path, overrides=limits) as rig:
        with pytest.raises(pamctl.PamctlError, match="safety trip") as tripped:
            rig.run(steps)
        assert tripped.value.exit_code == ExitCode.SAFETY_TRIP
        assert tripped.value.log is not None
        assert pamctl.Run.open(tripped.value.log).ending.code == ExitCode.SAFETY_TRIP
        assert "ack()" in tripped.value.fix
        with pytest.raises(pamctl.PamctlError, match="acknowledge it first"):
            rig.goto(5e-3)
        assert "safety trip" in rig.ack()
        rig.goto(5e-3)


def test_the_code_of_a_fault_is_not_that_of_the_one_before_it(rig, monkeypatch):
    rig.goto(5e-3, within_s=0.5)
    late = Ending(ExitCode.OVERRUNS, "too many ticks were missed")
    monkeypatch.setattr(loop_of(rig), "find_stop", lambda tick: late)
    with pytest.raises(pamctl.PamctlError, match="too many ticks") as first:
        rig.sleep(1.0)
    assert first.value.exit_code == ExitCode.OVERRUNS
    rig.ack()
    rig.estop()  # while idle: no loop tells a code
    with pytest.raises(pamctl.PamctlError, match="emergency stop") as second:
        next(rig.live())
    assert second.value.exit_code == ExitCode.SAFETY_TRIP


def test_a_session_that_does_not_end_well_is_a_fault_and_not_idle(rig):
    rig.goto(5e-3, within_s=0.5)
    loop_of(rig).stop_now()
    with pytest.raises(pamctl.PamctlError, match="emergency stop") as ended:
        rig.disarm()
    assert ended.value.exit_code == ExitCode.SAFETY_TRIP
    assert rig.state == "fault"
    rig.ack()
    rig.goto(5e-3, within_s=0.5)
    rig.disarm()
    assert rig.state == "idle"


def test_a_log_whose_loop_ends_before_its_first_tick_says_how_it_ended(rig, tmp_path, monkeypatch):
    begin = InProcessLoop.begin

    def begin_after_a_stop(loop: InProcessLoop, *of: Any) -> None:
        loop.stop_now()  # another thread, just before the run
        begin(loop, *of)

    monkeypatch.setattr(InProcessLoop, "begin", begin_after_a_stop)
    with pytest.raises(pamctl.PamctlError, match="emergency stop"):
        rig.goto(5e-3)
    (log,) = tmp_path.glob("*.mcap")
    assert read(log).events[-1]["reason"] == "emergency stop"


def test_a_wait_for_a_held_position_is_refused_at_once_and_one_with_an_end_returns(
    rig, monkeypatch
):
    rig.goto(5e-3, within_s=0.5)

    def wait_in_vain(*_: object) -> None:
        raise AssertionError("it waits for an end that does not come")

    with monkeypatch.context() as patch:
        patch.setattr(loop_of(rig), "advance", wait_in_vain)
        with pytest.raises(pamctl.PamctlError, match=r"has no end; stop\(\) ends it") as refused:
            rig.wait()
    assert refused.value.exit_code == ExitCode.USAGE
    rig.stop()
    assert rig.wait().ending.reason == "stopped by request"
    rig.start(pamctl.Hold(position_mm=5), duration_s=0.5)
    assert rig.wait().ending.code == ExitCode.OK


def test_a_motion_that_another_thread_stops_has_not_arrived(rig, monkeypatch):
    begin = rig._begin

    def begin_and_be_stopped(order: str, /, **params: object) -> Path:
        log = begin(order, **params)
        rig.stop()  # the other thread has its turn just now
        return log

    monkeypatch.setattr(rig, "_begin", begin_and_be_stopped)
    with pytest.raises(pamctl.PamctlError, match="the motion was stopped") as stopped:
        rig.goto(5e-3)
    assert stopped.value.exit_code == ExitCode.CHECK_FAILED
    assert stopped.value.log is not None
    assert pamctl.Run.open(stopped.value.log).ending.reason == "stopped by request"


def test_the_emergency_stop_ends_the_run_at_once_and_is_latched(rig):
    log = rig.start(SINE)
    rig.sleep(1.5)
    rig.estop()
    assert rig.state == "fault"
    run = pamctl.Run.open(log)
    assert run.ending == (ExitCode.SAFETY_TRIP, "emergency stop")
    assert read_row(log).ending == "estop"
    assert rig.ack() == "emergency stop"
    assert rig.state == "idle"


def test_a_run_is_arrays_units_tables_and_pictures(rig, tmp_path):
    run = rig.run(SINE)
    figures = run.metrics
    tracked = np.isin(run["phase"], (2, 3))
    assert figures.max_error_m == pytest.approx(np.abs(run.error_m[tracked]).max())
    assert figures.rms_error_m == pytest.approx(np.sqrt(np.mean(run.error_m[tracked] ** 2)))
    assert figures.ticks == len(run) == len(run.t_s)
    assert run.units["position_m"] == "m"
    frame = run.to_pandas(["position_m", "reference_m"])
    assert list(frame.columns) == ["position_m", "reference_m"]
    assert frame.attrs["units"]["position_m"] == "m"
    assert frame["position_m"].to_numpy() == pytest.approx(run["position_m"])
    shown = run._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert "&lt;svg" in shown
    assert run.report(tmp_path / "page.html").read_text().startswith("<!doctype html>")
    with pytest.raises(pamctl.PamctlError, match="did you mean"):
        run["positon_m"]
    with pytest.raises(pamctl.PamctlError) as missing:
        pamctl.Run.open(tmp_path / "none.mcap")
    assert missing.value.exit_code == ExitCode.BAD_DATA


def test_importing_pamctl_loads_nothing():
    program = (
        "import sys, pamctl; heavy = {'numpy', 'pydantic', 'scipy', 'pamctl.session'}\n"
        "assert not heavy & {*sys.modules}, heavy & {*sys.modules}\n"
        "import pamctl.offline.merit as merit\n"
        "assert merit.STEADY_S and callable(pamctl.simulate)\n"
        "assert 'Sine' in dir(pamctl)"
    )
    done = run_process([sys.executable, "-c", program])
    assert done.returncode == 0, done.stderr


def test_gains_are_searched_and_each_generation_is_told():
    heard: list[tuple[int, float]] = []
    found = pamctl.find_gains("pid", generations=2, progress=lambda *told: heard.append(told))
    assert [generation for generation, _ in heard] == [1, 2]
    assert heard[1][1] <= heard[0][1]
    assert found["law"] == "pid"
