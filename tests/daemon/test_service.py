"""The daemon as a service: the watchdog, waits, long orders, and what it tidies up."""

import configparser
import itertools
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.command_line import run_process
from support.patience import BUSY_PC, PATIENCE_S, await_true
from support.processes.daemons import NOT_HOMED, QUICK, Daemon, daemon, parked

from pamctl.base.errors import Ending, ExitCode
from pamctl.daemon.client import Client
from pamctl.daemon.monitor_handle import MonitorHandle
from pamctl.daemon.shelf import Latch, Shelf
from pamctl.log import read
from pamctl.offline.tick_replay import replay_log
from pamctl.processes.backends import ao_path, new_ring_path
from pamctl.processes.run_once import make_run_meta
from pamctl.recording import recorded_run
from pamctl.recording.ring import Ring
from pamctl.settings.resolve import resolve

UNIT = Path(__file__).parents[2] / "scripts" / "pamctl.service"
INSTALLED = "/opt/pamctl/.venv/bin/pamctl"


def unit() -> configparser.SectionProxy:
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[method-assign, assignment]
    parser.read_string(UNIT.read_text())
    return parser["Service"]


def test_systemd_accepts_the_unit(tmp_path):
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("no systemd-analyze (apt-get install systemd)")
    program = tmp_path / "pamctl"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    there = tmp_path / "pamctl.service"
    there.write_text(UNIT.read_text().replace(INSTALLED, str(program)))
    done = run_process([analyze, "verify", "--man=no", str(there)])
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_the_unit_does_not_restart_after_a_trip_or_a_wrong_setting():
    never = {int(code) for code in unit()["RestartPreventExitStatus"].split()}
    assert never == {ExitCode.USAGE, ExitCode.SAFETY_TRIP, ExitCode.BAD_CONFIG}
    assert unit()["Restart"] == "on-failure"
    assert unit()["Type"] == "notify"


def test_the_command_after_its_end_drives_the_safe_voltage(tmp_path):
    device = f"test-post-{os.getpid()}"
    done = run_process(_command(unit()["ExecStopPost"], tmp_path, device))
    ao_path(device).unlink(missing_ok=True)
    ao_path(device).with_suffix(".lock").unlink(missing_ok=True)
    assert done.returncode == 0, done.stderr
    assert "safe" in done.stdout


def _command(line: str, folder: Path, device: str) -> list[str]:
    """A command of the unit with its places moved below `folder`, on a simulated rig."""
    rig = Path(__file__).parents[2] / "config" / "rig" / "sim.yaml"
    moved = line.replace(INSTALLED, f"{sys.executable} -m pamctl")
    moved = moved.replace("/etc/pamctl/rig.yaml", str(rig)).replace(" --group pamctl", "")
    moved = re.sub(r"/(run|var/lib)/pamctl", str(folder), moved)
    return [*shlex.split(moved), "--set", f"rig.sim.device={device}"]


class Manager:
    """What systemd would hear, on a real datagram socket."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)
        self.environment = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": "400000"}

    def heard(self, seconds: float) -> list[str]:
        end_s, lines = time.monotonic() + seconds, []
        while time.monotonic() < end_s:
            try:
                lines += self._socket.recv(4096).decode().splitlines()
            except BlockingIOError:
                time.sleep(0.01)
        return lines

    def wait_for(self, line: str) -> None:
        await_true(lambda: line in self.heard(0.1), f"no {line}", 0.0)

    def close(self) -> None:
        self._socket.close()


@pytest.mark.long
def test_it_is_ready_when_it_answers_and_the_loops_progress_feeds_the_watchdog(tmp_path):
    manager, device = Manager(tmp_path / "notify"), f"test-unit-{os.getpid()}"
    patient = ["rig.loop.heartbeat_ms=10000", "rig.homing.enabled=false"]
    command = _command(unit()["ExecStart"], tmp_path, device)
    for setting in [*QUICK, *BUSY_PC, *patient]:
        command += ["--set", setting]
    process = subprocess.Popen(command, env={**os.environ, **manager.environment})
    try:
        manager.wait_for("READY=1")
        with Client(tmp_path / "control.sock") as client:
            assert client.call("status")["state"] == "idle"
            manager.wait_for("WATCHDOG=1")  # idle is no fault
            client.call("goto", {"position_m": 5e-3, "within_s": 0.5})
            await_true(lambda: client.call("status")["state"] == "ready")
            manager.wait_for("WATCHDOG=1")
            loop = client.call("status")["pids"]["loop"]
            os.kill(loop, signal.SIGSTOP)
            # The daemon lives, its loop does not.
            await_true(lambda: "WATCHDOG=1" not in manager.heard(1.0))
            os.kill(loop, signal.SIGCONT)
            manager.wait_for("WATCHDOG=1")
        process.send_signal(signal.SIGTERM)
        manager.wait_for("STOPPING=1")
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        manager.close()
        for suffix in (".ao", ".lock", ".fault"):
            ao_path(device).with_suffix(suffix).unlink(missing_ok=True)


# --- waits ---------------------------------------------------------------------------------------

DIES_WITH_ITS_SECOND_RUN = """
import os, sys
if "pamctl.processes.loop_main" in sys.orig_argv:
    from pamctl.realtime.steering import SteeredProgram
    begin, begun = SteeredProgram._begin_run, []

    def begin_or_die(self, *of):
        begun.append(of)
        if len(begun) == 2:
            os.kill(os.getpid(), 9)
        begin(self, *of)

    SteeredProgram._begin_run = begin_or_die
"""


def test_a_loop_that_dies_over_an_order_is_a_fault_and_the_daemon_still_ends(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(DIES_WITH_ITS_SECOND_RUN)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    with daemon(tmp_path, "dies", NOT_HOMED) as made:
        log = Path(made.ask("goto", position_m=4e-3)["log"])
        made.wait_for("ready")
        steps = {"kind": "steps", "steps": [{"valve_v": 0.0, "hold_s": 1.0}]}
        made.ask("start", experiment=steps, name="second")
        status = made.wait_for("fault")
        assert "the loop process was killed by SIGKILL" in status["fault"]
        made.wait_until(lambda status: not status["pids"])
        assert made.is_safe()
        assert read(log).events[-1]["event"] == "outcome"
        made.process.send_signal(signal.SIGTERM)
        assert made.process.wait(PATIENCE_S) == 0


def test_a_recorder_that_never_finishes_is_killed_and_the_note_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(recorded_run, "_FINISH_PATIENCE_S", 0.3)
    names = {"controller": "qsmc", "experiment": "tracking-1", "rig": "sim"}
    meta = make_run_meta(resolve(experiment="tracking-1"), names, tmp_path / "run.mcap")
    recorder = subprocess.Popen(["sleep", "1000"], stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    is_over = threading.Event()
    with Ring.create(new_ring_path(), meta) as ring:

        def beat() -> None:
            for beats in itertools.count():
                ring.recorder_beats = beats
                if is_over.wait(1e-3):
                    return

        ring.loop_done = 1
        beating = threading.Thread(target=beat)
        beating.start()
        monkeypatch.setattr(recorded_run, "spawn_recorder", lambda path: recorder)
        report = recorded_run.ProcessRecordedRun("run", ring).finish(Ending(ExitCode.OK, ""))
        is_over.set()
        beating.join()
    assert recorder.returncode == -signal.SIGKILL
    assert report.ending == (
        ExitCode.UNEXPECTED,
        "the recorder did not finish the log within 0.3 s",
    )


SILENT_FOR_100_MS_IS_KILLED = ("rig.loop.heartbeat_ms=100", "rig.loop.starved_ms=60000")
"""A loop that works on something else for so long; not one that a busy PC gives no time."""


@pytest.fixture(scope="module")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon whose loop is killed as soon as it works on something else."""
    place = tmp_path_factory.mktemp("long")
    with daemon(place, "long", NOT_HOMED, *SILENT_FOR_100_MS_IS_KILLED) as made:
        yield made


LONG: tuple[dict[str, Any], ...] = (
    {"kind": "steps", "steps": [{"valve_v": 0.0, "hold_s": 0.5}] * 7000},
    {"kind": "square", "frequency_hz": 250, "amplitude_v": 0.1, "cycles": 200_000},
    {"kind": "tracking", "offset_mm": 5.0, "amplitude_mm": 1.0, "cycles": 100_000},
)


@pytest.mark.long
def test_a_long_program_does_not_make_the_loop_late(strict):
    strict.ask("goto", position_m=4e-3)
    strict.wait_for("ready")
    for experiment in LONG:
        log = Path(strict.ask("start", experiment=experiment, name="long")["log"])
        strict.wait_until(lambda status: status["log"] == str(log) and status["tick"] is not None)  # noqa: B023
        strict.wait_ticks(200)
        assert strict.state() == "running"
        strict.ask("stop")
        parked(strict)
        assert strict.state() == "ready"
        ran = read(log)
        (order,) = [event for event in ran.events if event["event"] == "order"]
        assert {**order["experiment"], **experiment} == order["experiment"]
        assert replay_log(ran).is_equal


def test_a_log_that_cannot_be_removed_is_told_and_the_others_still_go(tmp_path):
    stuck, old, newest = (tmp_path / f"20260101-00000{number}-daemon-x.mcap" for number in range(3))
    stuck.mkdir()  # no file: it cannot be unlinked, whoever asks
    old.touch()
    newest.touch()
    problem = Shelf(tmp_path, keep=1).put_away(newest)
    assert str(stuck) in problem
    assert not old.exists()
    assert newest.exists()


def test_the_first_reason_of_a_fault_stays_until_it_is_acknowledged(tmp_path):
    latch = Latch(tmp_path / "fault")
    latch.engage("the cause")
    latch.engage("what came of it")
    assert latch.reason == Latch(tmp_path / "fault").reason == "the cause"
    assert latch.release() == "the cause"
    assert Latch(tmp_path / "fault").reason == ""


def test_a_trip_of_the_monitor_does_not_wait_for_a_mark_that_is_held_up():
    held_up, tripped = threading.Event(), []
    desk = MonitorHandle(
        None, lambda *_, **__: None, lambda _: held_up.wait(PATIENCE_S), tripped.append
    )
    alarm = {
        "kind": "alarm", "block": "mechanics", "since_s": 0.0, "over_floor": 4.0, "rms": 1e-4,
        "activity": "moving",
    }  # fmt: skip
    began_s = time.monotonic()
    desk._take(alarm)
    held_up.set()
    assert len(tripped) == 1
    assert time.monotonic() - began_s < PATIENCE_S / 2


def test_a_monitor_that_is_closed_is_not_announced_as_ended():
    announced: list[str] = []
    desk = MonitorHandle(resolve().plant, lambda name, **_: announced.append(name), print, None)
    desk.close()
    desk._reader.join(PATIENCE_S)
    desk._process.stdout.close()
    assert announced == []
