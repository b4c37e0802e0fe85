"""`pamctl run` on the card, from the command to the log, over the stand-in driver.

However a run ends: the output at the safe voltage, the log complete to its last tick, the exit code
as documented. Made-up time and the other faults: `test_faults.py`.
"""

import json
import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from standin.standin import PERMIT, Card, here, library
from support.card_rigs import READ_VOLTS
from support.command_line import run_pamctl
from support.patience import PATIENCE_S
from support.processes.card_runs import AT_ONCE, OWN_SAFE_V, RUN, await_writes, log_of, own, start
from support.processes.children import await_children
from support.processes.daemons import QUICK
from support.runs import AO_STEP_V

from pamctl.realtime.scheduling import GUARDIAN_PRIORITY
from pamctl.signals import Phase

assert own  # a fixture

PACED_BY_THE_CARD = ("--set", "rig.nidaq.timing=hardware_timed")
MOVING = 300
"""Writes after which the valve is off its safe voltage."""


@pytest.mark.long
def test_a_run_on_the_card_is_complete_and_ends_at_the_safe_voltage(own):
    own.fail("DAQmxWriteAnalogScalarF64", hang_s=6.5e-3, is_deaf=True, after=MOVING, times=1)
    # In the plainest of locales: every name handed to the driver must survive it.
    quick = [part for setting in QUICK for part in ("--set", setting)]
    process = start(own, "--duration", "1", "--json", *quick, LC_ALL="C")
    said, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, complaints
    report = json.loads(said)
    assert report["log_is_whole"]
    assert report["backend"] == "nidaq"

    assert own.written_v[-1] == own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    log = log_of(own)
    assert log["missed"].max() >= 5, "a write that took too long"
    assert np.array_equal(np.diff(log["tick"]) - 1, log["missed"][1:])
    assert log["phase"][-1] == Phase.STOPPING
    assert np.ptp(log["t_s"][log["phase"] == Phase.APPROACH]) > 0.5
    identity = log.metadata["rig"]
    assert identity["library"] == str(library())
    assert identity["serial_number"] == "DECAF"
    # Every tick's write is on record as the card saw it: the last ones, whole.
    last_writes = own.written_v[-20:-4]
    applied = log["applied_v"].tolist()
    found = [applied[at : at + 16] == last_writes for at in range(len(applied) - 16, 0, -1)]
    assert any(found[:16])


def test_ctrl_c_leaves_the_card_safe_its_driver_s_threads_and_its_guardian_were_raised(own):
    """Else a killed loop frees the card, and the guardian acts, only when a busy CPU allows it."""
    process = start(own, *AT_ONCE)
    await_writes(own, process, 300)
    children = await_children(process.pid, "loop_main", "guardian_main")
    loop, guardian = children["loop_main"], children["guardian_main"]
    tasks = [int(task) for task in os.listdir(f"/proc/{loop}/task")]
    own_cpus = os.sched_getaffinity(loop)
    found = [
        (os.sched_getscheduler(task) & 0xFFFF, os.sched_getaffinity(task))
        for task in tasks
        if task != loop
    ]
    guards = os.sched_getparam(guardian).sched_priority, os.sched_getaffinity(guardian)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    assert log_of(own)["phase"][-1] == Phase.STOPPING
    (noted,) = (e for e in log_of(own).events if e["event"] == "foreign_threads")
    if os.geteuid() or os.sched_getaffinity(0) == own_cpus or not noted["done"]:
        pytest.skip("needs two CPUs and SCHED_FIFO, which only root is sure to be allowed")
    assert found == [(os.SCHED_FIFO, os.sched_getaffinity(0))] * 4
    assert guards == (GUARDIAN_PRIORITY, os.sched_getaffinity(0) - own_cpus)


def assert_left_in_order(card: Card, process: subprocess.Popen[str], code: int) -> str:
    """Check what must hold after every end; return what was said of it."""
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, said
    assert card.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    log = log_of(card)
    assert np.array_equal(np.diff(log["tick"]) - 1, log["missed"][1:])
    assert [event["event"] for event in log.events].count("outcome") == 1
    assert len(log) > MOVING // 2
    return said


@pytest.mark.long
def test_a_driver_that_never_returns_is_killed_with_its_loop_and_the_next_start_is_clean(own):
    """The read ignores its timeout and all signals: only the guardian can act."""
    own.fail(READ_VOLTS, hang_s=60.0, is_deaf=True, after=MOVING, times=1)
    process = start(own, *AT_ONCE, *PACED_BY_THE_CARD)
    said = assert_left_in_order(own, process, code=1)
    assert "silent for" in said
    assert "the guardian drove the safe voltage" in said
    assert any(event["event"] == "guardian_takeover" for event in log_of(own).events)
    own.mend()
    (own.path.parent / "cwd" / "run.mcap").unlink()
    process = start(own, *AT_ONCE, *PACED_BY_THE_CARD, "--duration", "0.1")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)


SOON_GIVEN_UP = """
import sys
if sys.orig_argv[-2].endswith("guardian_main") or "run" in sys.orig_argv:
    from pamctl.processes.guardian import drive_safe
    drive_safe.__defaults__ = (0.3,)
"""


@pytest.mark.long
def test_a_card_that_is_gone_ends_with_69_its_own_words_and_an_alarm(own, tmp_path):
    """No software reaches the output then: a person must act."""
    (tmp_path / "sitecustomize.py").write_text(SOON_GIVEN_UP)
    path = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH")]))
    process = start(own, *AT_ONCE, PYTHONPATH=path)
    await_writes(own, process, MOVING)
    own.registers.is_gone = 1
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 69, said
    next_ones = ("reading the encoder", "reading the pressure sensor", "writing to the valve")
    assert any(call in said for call in next_ones), said
    assert "-201003" in said
    assert "THE SAFE VOLTAGE COULD NOT BE DRIVEN" in said
    assert "cut the air supply" in said
    assert "Traceback" not in said
    log = log_of(own)
    assert np.array_equal(np.diff(log["tick"]) - 1, log["missed"][1:])
    assert log.events[-1]["code"] == 69


def test_a_loop_paced_by_the_card_that_dies_leaves_it_safe(own):
    process = start(own, *AT_ONCE, *PACED_BY_THE_CARD, STANDIN_THREADS="0")
    await_writes(own, process, MOVING)
    loop = await_children(process.pid, "loop_main")["loop_main"]
    # Python packages start no threads: each would have to die as well.
    assert len(list(Path(f"/proc/{loop}/task").iterdir())) == 1
    os.kill(loop, signal.SIGKILL)
    assert "the guardian drove the safe voltage" in assert_left_in_order(own, process, code=1)


def test_a_card_that_cannot_be_had_is_refused_before_anything_is_touched(tmp_path, monkeypatch):
    monkeypatch.setenv(PERMIT, "1")
    before = here().registers.ao_writes
    done = run_pamctl(*RUN[1:], "--set", "rig.nidaq.device=Dev9", cwd=tmp_path)
    assert done.returncode == 69
    assert "nilsdev" in done.stderr
    assert "Traceback" not in done.stderr
    assert here().registers.ao_writes == before
    assert not list(tmp_path.iterdir())


def test_a_broken_env_file_beside_the_run_is_named_as_the_culprit(own):
    (own.path.parent / "cwd" / ".env").write_bytes(b"\xff\xfe")
    process = start(own, *AT_ONCE)
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 69
    assert "a broken .env" in complaints
    assert "Traceback" not in complaints
