"""The unit for systemd, and what the daemon tells a service manager."""

from __future__ import annotations

import configparser
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.command_line import run_process
from support.patience import BUSY_PC, PATIENCE_S, await_true
from support.processes.daemons import QUICK

from pamctl.daemon.client import Client
from pamctl.exit_codes import ExitCode
from pamctl.processes.backends import ao_path

UNIT = Path(__file__).parents[2] / "scripts" / "pamctl.service"
INSTALLED = "/opt/pamctl/.venv/bin/pamctl"


def unit() -> configparser.SectionProxy:
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[method-assign, assignment]
    parser.read_string(UNIT.read_text())
    return parser["Service"]


def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
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


def test_the_unit_does_not_restart_after_a_trip_or_a_wrong_setting() -> None:
    never = {int(code) for code in unit()["RestartPreventExitStatus"].split()}
    assert never == {ExitCode.USAGE, ExitCode.SAFETY_TRIP, ExitCode.BAD_CONFIG}
    assert unit()["Restart"] == "on-failure"
    assert unit()["Type"] == "notify"


def test_the_command_after_its_end_drives_the_safe_voltage(tmp_path: Path) -> None:
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
def test_it_is_ready_when_it_answers_and_the_loops_progress_feeds_the_watchdog(
    tmp_path: Path,
) -> None:
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
