"""A session with a running daemon: what it does, and how it is left."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run_pamctl
from support.patience import PATIENCE_S
from support.processes.daemons import TRACKING, Daemon, daemon, parked

import pamctl
from pamctl.base.errors import ExitCode
from pamctl.offline.tick_replay import replay_log
from pamctl.session.daemon_rig import connect

SINE = pamctl.Sine(offset_mm=4, amplitude_mm=1, frequency_hz=2, cycles=2, fade_s=0.3)


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with daemon(tmp_path_factory.mktemp("session"), "session") as made:
        yield made


@pytest.mark.long
def test_positions_runs_gains_and_marks_are_those_of_the_simulation(up):
    with connect(up.socket) as rig:
        rig.goto(4e-3, within_s=0.6)
        assert rig.state == "ready"
        assert rig.status()["tick"]["reference_m"] == pytest.approx(4e-3)
        rig.start(pamctl.MotionSequence(parts=[pamctl.Move(to_mm=4, duration_s=0.5), SINE]))
        newest = [tick["tick"] for tick in rig.live(rate_hz=50, duration_s=0.5)]
        rig.mark("from Python")
        assert rig.set(lambda_per_s=12, ramp_s=0.1)["lambda_per_s"] == 12
        run = rig.wait()
        assert rig.gains["lambda_per_s"] == 12
        assert rig.state == "ready"
    assert len(newest) == 25
    assert np.all(np.diff(newest) > 0)
    assert [text for _, text in run.marks] == ["from Python"]
    assert run.settings["experiment"]["kind"] == "sequence"
    assert np.nanmax(run["reference_m"]) == pytest.approx(5e-3, rel=0.03)  # ticks may be missed
    assert replay_log(run.log).is_equal
    assert up.is_safe()


def test_leaving_the_block_stops_what_was_begun_in_it_and_nothing_else(up, monkeypatch):
    with pytest.raises(RuntimeError, match="mine"), connect(up.socket) as rig:
        log = rig.start(SINE)
        up.wait_for("running")
        raise RuntimeError("mine")
    assert up.ask("status")["run"] is None
    assert up.is_safe()
    assert pamctl.Run.open(log).ending.reason == "stopped by request"
    with connect(up.socket) as rig:
        ask = rig._link.ask

        def ask_and_interrupt(order: str, params: dict[str, object]) -> object:
            answer = ask(order, params)
            if order == "start":
                raise KeyboardInterrupt
            return answer

        monkeypatch.setattr(rig._link, "ask", ask_and_interrupt)
        with pytest.raises(KeyboardInterrupt):
            rig.run(SINE)
        assert up.ask("status")["run"] is None
        other = Path(up.ask("start", experiment=TRACKING, name="other")["log"])
    with connect(up.socket) as rig:
        assert rig.status()["log"] == str(other)
        with pytest.raises(pamctl.PamctlError, match="not now"):
            rig.run(SINE)
    assert up.ask("status")["log"] == str(other)
    parked(up)
    assert pamctl.Run.open(other).ending.code == ExitCode.OK


def test_ctrl_c_stops_the_run_and_leaves_the_valve_safe(up):
    program = (
        "import pamctl\n"
        f"with pamctl.connect({str(up.socket)!r}) as rig:\n"
        "    rig.run(pamctl.Sine(offset_mm=4, amplitude_mm=1, frequency_hz=1, cycles=1000))\n"
    )
    child = subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.PIPE)
    status = up.wait_until(lambda status: status["state"] == "running")
    os.kill(child.pid, signal.SIGINT)
    _, said = child.communicate(timeout=PATIENCE_S)
    assert b"KeyboardInterrupt" in said
    assert up.ask("status")["run"] is None
    assert up.is_safe()
    assert pamctl.Run.open(status["log"]).ending.reason == "interrupted"


def test_a_fault_is_raised_with_its_code_and_its_log_and_acknowledged(up):
    with connect(up.socket) as rig:
        log = rig.start(SINE)
        up.wait_for("running")
        rig.estop()
        with pytest.raises(pamctl.PamctlError, match="emergency stop") as fault:
            rig.wait()
        assert fault.value.exit_code == ExitCode.SAFETY_TRIP
        assert fault.value.log == log
        with pytest.raises(pamctl.PamctlError, match="acknowledge it first") as refused:
            rig.goto(9e-3)
        assert refused.value.exit_code == ExitCode.CHECK_FAILED
        assert rig.ack() == "emergency stop"
        assert rig.state == "idle"


def test_an_acknowledgement_does_not_wait_for_the_monitor_to_end(tmp_path, monkeypatch):
    """The monitor lives as long as the daemon does."""
    with daemon(tmp_path, "watched", options=["--monitor"]) as made, connect(made.socket) as rig:
        rig.estop()
        status = rig.status()
        assert list(status["pids"]) == ["monitor"]

        def wait_in_vain(duration_s: float) -> None:
            raise AssertionError("no loop is left to wait for")

        monkeypatch.setattr(rig._link, "sleep", wait_in_vain)
        assert rig.ack() == "emergency stop"
        assert rig.state == "idle"


def test_refusals_are_the_shells(up, tmp_path):
    with pytest.raises(pamctl.PamctlError, match="no daemon listens there") as absent:
        connect(tmp_path / "none.sock")
    assert absent.value.exit_code == ExitCode.UNAVAILABLE
    assert absent.value.fix.startswith("start one with `pamctl daemon`")
    with connect(up.socket) as rig:
        before = rig.gains
        done = run_pamctl("set", "controller.lambda_per_s=-3", "--socket", up.socket)
        with pytest.raises(pamctl.PamctlError) as refused:
            rig.set(lambda_per_s=-3)
        assert done.stderr.strip() == f"error: {refused.value}"
        assert done.returncode == refused.value.exit_code
        assert rig.gains == before
    with pytest.raises(pamctl.PamctlError, match="closed"):
        rig.status()
