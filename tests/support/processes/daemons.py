"""A real daemon on the simulated rig, for the tests that steer it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hal.sim import peek_v
from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError
from pamctl.processes.backends import ao_path
from support.patience import BUSY_PC, PATIENCE_S, await_true

AO_STEP_V = 20.0 / 65536.0
SAFE_V = 0.0

QUICK = ["rig.homing.steady_s=0.05", "rig.homing.fills=1", "rig.loop.stop_ramp_s=0.2"]
"""Homing in a second instead of three, and a short stop."""

SQUARE: dict[str, Any] = {"kind": "square", "frequency_hz": 4.0, "cycles": 1}
TRACKING: dict[str, Any] = {
    "kind": "tracking", "offset_mm": 8.0, "amplitude_mm": 2.0, "transition_s": 0.5,
    "approach_s": 0.5, "settle_s": 0.1, "cycles": 1,
}  # fmt: skip

NOT_HOMED = "rig.homing.enabled=false"


as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be several users")


@contextmanager
def nobody() -> Iterator[None]:
    """Be another user for a while."""
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@dataclass
class Daemon:
    """A daemon process and how to talk to it."""

    process: subprocess.Popen[bytes]
    socket: Path
    logs: Path
    device: str
    told: Path
    """What it wrote to standard output."""

    def client(self) -> Client:
        return Client(self.socket)

    def ask(self, method: str, **params: Any) -> Any:
        with self.client() as client:
            return client.call(method, params)

    def state(self) -> str:
        return str(self.ask("status")["state"])

    def wait_for(self, *states: str) -> dict[str, Any]:
        """Return the status once the state is one of `states`."""
        return self.wait_until(lambda status: status["state"] in states)

    def wait_until(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            status: dict[str, Any] = self.ask("status")
            if holds(status):
                return status
            assert time.monotonic() < deadline_s, status
            time.sleep(0.02)

    def acknowledge(self) -> None:
        """Acknowledge the fault as soon as the loop that it ended has ended."""
        self.wait_until(lambda status: status["state"] == "fault")
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                self.ask("ack")
                return
            except DaemonDeclinedError as error:
                if "try again" not in str(error) or time.monotonic() > deadline_s:
                    raise
                time.sleep(0.02)

    def wait_ticks(self, count: int) -> None:
        """Return when the loop is this many ticks further."""
        tick = self.ask("status")["tick"]["tick"]
        self.wait_until(lambda status: status["tick"]["tick"] >= tick + count)

    def is_safe(self) -> bool:
        """Tell whether the output, as the simulated card holds it, is at the safe voltage."""
        volts = peek_v(ao_path(self.device))
        return volts is not None and abs(volts - SAFE_V) <= AO_STEP_V

    def wait_safe(self) -> None:
        await_true(self.is_safe, every_s=1e-3)

    def finished_logs(self) -> list[Path]:
        return sorted(self.logs.glob("*.mcap"))


@contextmanager
def daemon(
    tmp_path: Path,
    name: str,
    *overrides: str,
    options: list[str] | None = None,
    forget: bool = True,
) -> Iterator[Daemon]:
    """Run a daemon; end it, whatever state it is in, and `forget` the fault that it latched."""
    device = f"test-{name}-{os.getpid()}"
    socket = tmp_path / "control.sock"
    settings = [f"rig.sim.device={device}", *QUICK, *BUSY_PC, *overrides]
    command = [sys.executable, "-m", "pamctl", "daemon", "--socket", str(socket)]
    command += ["--logs", str(tmp_path / "logs"), "--rt", "off", *(options or [])]
    command += [part for setting in settings for part in ("--set", setting)]
    said = tmp_path / "daemon.err"
    told = tmp_path / "daemon.out"
    with said.open("wb") as errors, told.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=errors)
    made = Daemon(process, socket, tmp_path / "logs", device, told)
    try:
        _await_answer(made, said)
        yield made
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise
        for suffix in (".ao", ".lock", *([".fault"] if forget else [])):
            ao_path(device).with_suffix(suffix).unlink(missing_ok=True)


def _await_answer(made: Daemon, said: Path) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            made.ask("status")
            return
        except DaemonUnreachableError:
            if made.process.poll() is not None or time.monotonic() > deadline_s:
                raise AssertionError(said.read_text()) from None
            time.sleep(0.02)


def parked(made: Daemon) -> dict[str, Any]:
    """Return the status once no run goes on."""
    return made.wait_until(
        lambda status: status["state"] in ("idle", "ready") and not status["log"]
    )


def run_to_its_end(made: Daemon, experiment: dict[str, Any], name: str = "test") -> Path:
    """Run an experiment; return its log, which is whole."""
    log = Path(made.ask("start", experiment=experiment, name=name)["log"])
    parked(made)
    return log
