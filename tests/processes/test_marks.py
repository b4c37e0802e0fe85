"""Marks from a second terminal, for a run without a daemon."""

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.patience import BUSY_PC, PATIENCE_S, await_true
from support.runs import run_settings
from typer.testing import CliRunner

from hal.sim import peek_v
from pamctl.base.texts import LONGEST_REMARK
from pamctl.cli.app import app
from pamctl.log import read
from pamctl.processes.backends import SHARED_MEMORY, ao_path
from pamctl.processes.marks import MarkError, list_running_runs, mark_run
from pamctl.processes.run_once import make_run_meta
from pamctl.realtime.orders import MARK_SLOT_BYTES
from pamctl.recording.ring import Ring
from pamctl.settings.config_files import DEFAULT_NAMES

DEVICE = f"testmarks{os.getpid()}"


def test_a_mark_reaches_the_log_of_a_run_without_a_daemon(tmp_path):
    log = tmp_path / "run.mcap"
    settings = [f"rig.sim.device={DEVICE}", "rig.homing.enabled=false", *BUSY_PC]
    command = [sys.executable, "-m", "pamctl", "run", "--quiet", "--log", str(log), "--rt", "off"]
    command += [part for setting in settings for part in ("--set", setting)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as front:
        try:
            (run,) = await_true(lambda: log.exists() and list_running_runs())
            assert run.log == log
            mark_run(run, "1")
            marked = CliRunner().invoke(app, ["mark", "\x1b[31mload\noff", "--log", str(log)])
            assert marked.exit_code == 0, marked.output
            assert CliRunner().invoke(app, ["mark", "x", "--log", "other.mcap"]).exit_code == 3
            with pytest.raises(MarkError, match="1 to 2000"):
                mark_run(run, "x" * (LONGEST_REMARK + 1))
            with ThreadPoolExecutor() as terminals:
                command = [sys.executable, "-m", "pamctl", "mark", "at once", "--log", str(log)]
                other = terminals.submit(subprocess.call, command)
                for _ in range(20):
                    mark_run(run, "at once")
                assert other.result() == 0
        finally:
            front.send_signal(signal.SIGINT)
            _, complaint = front.communicate(timeout=PATIENCE_S)
    assert front.returncode == 130, complaint.decode()
    marks = [event for event in read(log).events if event["event"] == "mark"]
    assert [mark["text"] for mark in marks] == ["1", "load off", *21 * ["at once"]]
    ticks = [mark["tick"] for mark in marks]
    assert ticks == sorted(ticks)
    assert set(ticks) <= set(read(log)["tick"].tolist())
    assert peek_v(ao_path(DEVICE)) == pytest.approx(0.0, abs=1e-3)
    assert not list_running_runs()
    for left in SHARED_MEMORY.glob(f"pamctl-{DEVICE}.*"):
        left.unlink()


def test_a_loop_that_takes_no_mark_is_reported_in_time(tmp_path, monkeypatch):
    monkeypatch.setattr("pamctl.processes.marks._PATIENCE_S", 0.05)
    path = SHARED_MEMORY / f"pamctl-{DEVICE}.ring"
    meta = make_run_meta(run_settings(), DEFAULT_NAMES, tmp_path / "run.mcap")
    with Ring.create(path, meta, 64, slot_bytes=MARK_SLOT_BYTES) as ring:
        (run,) = (run for run in list_running_runs() if run.ring == path)
        for why in ("did not take the order", "did not take the order"):  # nor the one before
            with pytest.raises(MarkError, match=why):
                mark_run(run, "one")
        ring.loop_done = 1
        assert path not in [run.ring for run in list_running_runs()]
        ring.unlink()


def test_the_ring_of_a_dead_run_takes_no_marks(tmp_path):
    path = SHARED_MEMORY / f"pamctl-{DEVICE}dead.ring"
    meta = make_run_meta(run_settings(), DEFAULT_NAMES, tmp_path / "run.mcap")
    Ring.create(path, meta, 64, slot_bytes=MARK_SLOT_BYTES).close()
    try:
        assert path not in [run.ring for run in list_running_runs()]
    finally:
        path.unlink()
