"""A loop that gets no CPU is starved, not frozen: the guardian tells them apart."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.made_up import meta
from support.patience import await_true

from pamctl.processes.guardian import CpuBooks, Silence
from pamctl.recording.ring import LoopStage, Ring

MS = 1_000_000
BUSY = "import os, sys; {setup}; print(flush=True)\nwhile True: pass"
CPU = max(os.sched_getaffinity(0))


@contextmanager
def process(code: str) -> Iterator[int]:
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as child:
        try:
            assert child.stdout is not None
            child.stdout.readline()
            yield child.pid
        finally:
            child.kill()


@contextmanager
def starved() -> Iterator[int]:
    """Run a busy process of the lowest class on a CPU that another one keeps busy."""
    pin = f"os.sched_setaffinity(0, {{{CPU}}})"
    idle = f"{pin}; os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))"
    with process(BUSY.format(setup=idle)) as pid, process(BUSY.format(setup=pin)):
        yield pid


def judge_after(pid: int, seconds: float) -> bool:
    books = CpuBooks(pid)
    books.open_account(time.monotonic_ns())
    time.sleep(seconds)
    return books.is_starved(time.monotonic_ns())


def test_a_process_that_wants_to_run_and_cannot_is_starved() -> None:
    with starved() as pid:
        await_true(lambda: judge_after(pid, 0.05))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may run a process as SCHED_FIFO")
def test_a_process_that_computes_for_ever_is_not_starved() -> None:
    first = "os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    with process(BUSY.format(setup=first)) as pid:
        await_true(lambda: not judge_after(pid, 0.05))


def test_a_process_that_sleeps_or_is_stopped_is_not_starved() -> None:
    with process("import time; print(flush=True); time.sleep(600)") as pid:
        assert not judge_after(pid, 0.02)
    with starved() as pid:
        os.kill(pid, signal.SIGSTOP)
        await_true(lambda: Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2][1] == "T")
        assert not judge_after(pid, 0.02)


def test_a_process_that_is_gone_is_not_starved() -> None:
    with process("print(flush=True)") as pid:
        pass
    assert not judge_after(pid, 0.0)


@pytest.fixture
def silent_ring(tmp_path: Path) -> Iterator[Ring]:
    with Ring.create(tmp_path / "a.ring", meta(tmp_path / "a.mcap"), 64) as ring:
        ring.loop_stage = LoopStage.TICKING
        yield ring


def find_fault(silence: Silence) -> str:
    """Look as often as a guardian does, until there is something to say."""
    return await_true(silence.find_fault, every_s=5e-3)


def test_a_starved_loop_is_given_time_and_then_called_starved(silent_ring: Ring) -> None:
    with starved() as pid:
        fault = find_fault(Silence(silent_ring, pid, 20 * MS, 200 * MS))
    if "starved" in fault:
        assert float(fault.split()[-2]) >= 200
    else:  # the busy machine let it run for a moment, just when it was judged
        assert "silent" in fault


def test_a_loop_that_is_stopped_is_given_no_more_time_than_before(silent_ring: Ring) -> None:
    with process("import time; print(flush=True); time.sleep(600)") as pid:
        os.kill(pid, signal.SIGSTOP)
        fault = find_fault(Silence(silent_ring, pid, 20 * MS, 3600_000 * MS))
    assert fault.startswith("the loop was silent for ")
