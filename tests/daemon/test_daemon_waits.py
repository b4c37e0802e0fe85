"""Whatever becomes of a loop or a recorder, nobody waits for it without end."""

from __future__ import annotations

import itertools
import signal
import subprocess
import threading
from pathlib import Path

import pytest
from support.patience import PATIENCE_S
from support.processes.daemons import NOT_HOMED, daemon

from pamctl.exit_codes import Ending, ExitCode
from pamctl.log import read
from pamctl.processes.backends import new_ring_path
from pamctl.processes.run_once import make_run_meta
from pamctl.recording import recorded_run
from pamctl.recording.ring import Ring
from pamctl.settings.resolve import resolve

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


def test_a_loop_that_dies_over_an_order_is_a_fault_and_the_daemon_still_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_a_recorder_that_never_finishes_is_killed_and_the_note_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
