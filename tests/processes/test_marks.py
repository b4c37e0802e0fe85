"""Marks from a second terminal, for a run without a daemon."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.patience import BUSY_PC, PATIENCE_S
from typer.testing import CliRunner

from hal.sim import peek_v
from pamctl.cli.app import app
from pamctl.log import read
from pamctl.plain_text import LONGEST_REMARK
from pamctl.processes.backends import SHARED_MEMORY, ao_path
from pamctl.processes.mark_desk import (
    MarkDesk,
    MarkError,
    list_running_runs,
    mark_run,
)

DEVICE = f"testmarks{os.getpid()}"


def await_run(log: Path) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not (log.exists() and list_running_runs()):
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def test_a_mark_reaches_the_log_of_a_run_without_a_daemon(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    settings = [f"rig.sim.device={DEVICE}", "rig.homing.enabled=false", *BUSY_PC]
    command = [sys.executable, "-m", "pamctl", "run", "--quiet", "--log", str(log), "--rt", "off"]
    command += [part for setting in settings for part in ("--set", setting)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as front:
        try:
            await_run(log)
            (run,) = list_running_runs()
            assert run.log == log
            mark_run(run, "load on")
            marked = CliRunner().invoke(app, ["mark", "\x1b[31mload\noff", "--log", str(log)])
            assert marked.exit_code == 0, marked.output
            assert CliRunner().invoke(app, ["mark", "x", "--log", "other.mcap"]).exit_code == 3
            with pytest.raises(MarkError, match="1 to 2000"):
                mark_run(run, "x" * (LONGEST_REMARK + 1))
            for bad in (b"{", b"[]", b'{"mark": ""}', b"\xff", b"9" * 60_000):
                with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
                    client.connect(f"\0{run.address}")
                    client.send(bad)
            mark_run(run, "after the noise")
        finally:
            front.send_signal(signal.SIGINT)
            _, complaint = front.communicate(timeout=PATIENCE_S)
    assert front.returncode == 130, complaint.decode()
    marks = [event for event in read(log).events if event["event"] == "mark"]
    assert [mark["text"] for mark in marks] == ["load on", "load off", "after the noise"]
    ticks = [mark["tick"] for mark in marks]
    assert ticks == sorted(ticks)
    assert set(ticks) <= set(read(log)["tick"].tolist())
    assert peek_v(ao_path(DEVICE)) == pytest.approx(0.0, abs=1e-3)
    assert not list_running_runs()
    for left in SHARED_MEMORY.glob(f"pamctl-{DEVICE}.*"):
        left.unlink()


def test_a_mark_waits_for_no_loop(tmp_path: Path) -> None:
    """The front also watches the loop: a loop that takes nothing must not hold it up."""
    desk = MarkDesk(tmp_path / "run.mcap")
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as first:
            first.connect(desk._listener.getsockname())
            first.send(b'{"mark": "one"}')
            desk.look()
            desk.look()
            first.setblocking(False)
            with pytest.raises(BlockingIOError):
                first.recv(100)
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as second:
                second.connect(desk._listener.getsockname())
                second.send(b'{"mark": "two"}')
                desk.look()
                assert b"refused" in second.recv(1000)
    finally:
        desk.close()
