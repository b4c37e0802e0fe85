"""Shared memory may be full or hold foreign files, and a loop that gets no CPU is not frozen."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.command_line import run_process
from support.made_up import meta
from support.patience import await_true
from support.processes.card_runs import OWN_SAFE_V, of, own
from support.processes.daemons import AO_STEP_V, as_root

from hal.reservation import open_shared
from hal.rig import RigError
from hal.sim import SharedRegister, peek_v
from pamctl.daemon.shelf import Latch
from pamctl.processes import backends
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.processes.guardian import CpuBooks, Silence
from pamctl.recording.recorder import finish_orphans
from pamctl.recording.ring import LoopStage, Ring, RingError
from pamctl.settings.resolve import resolve

assert own  # a fixture

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
DEVICE = "shared0"
ON_DEVICE = ("--set", f"rig.sim.device={DEVICE}")
FULL = """mount -t tmpfs -o size=12k tmpfs "$0" && {} cat /dev/zero >"$0/filler"
"$@"; code=$?; cp "$0"/*.ao . 2>/dev/null; exit $code"""
"""A shell script that fills a shared memory which nobody else sees, and keeps the output."""


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A shared memory for this test alone."""
    place = Path(tempfile.mkdtemp(dir=SHARED_MEMORY))
    monkeypatch.setenv("PAMCTL_SHARED_MEMORY", str(place))
    monkeypatch.chdir(tmp_path)
    return place


def run_verb(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return run_process([PAMCTL, *words])


def run_safe_in_full_memory(
    place: Path, before: str = "", options: tuple[str, ...] = ON_DEVICE
) -> subprocess.CompletedProcess[str]:
    command = ["unshare", "-rm", "sh", "-c", FULL.format(before), place, PAMCTL, "safe"]
    done = run_process([*command, *options])
    if "unshare" in done.stderr or "mount" in done.stderr:
        pytest.skip("this PC lets nobody mount")
    return done


def test_safe_says_not_safe_where_full_memory_has_no_room_for_the_output(shared):
    done = run_safe_in_full_memory(shared)
    assert done.returncode == 69, done.stderr
    assert f"NOT SAFE, {DEVICE}" in done.stderr
    assert "No space left" in done.stderr


def test_safe_drives_an_output_that_was_there_before_the_memory_was_full(shared, tmp_path):
    left = tmp_path / "left" / f"pamctl-{DEVICE}.ao"
    left.parent.mkdir()
    register = SharedRegister(left, DEVICE)
    register.reserve()
    register.volts = 8.0
    register.release()
    done = run_safe_in_full_memory(shared, f'cp -p {left} "$0" &&')
    assert done.returncode == 0, done.stderr
    assert peek_v(tmp_path / left.name) == 0.0


def test_safe_drives_a_card_whatever_the_memory(shared, own, monkeypatch):
    for name, value in own.environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("PAMCTL_SHARED_MEMORY", str(shared))
    safe_volts = ("--set", f"rig.safe_volts={OWN_SAFE_V}")
    done = run_safe_in_full_memory(shared, "", ("--backend", "nidaq", *of(own), *safe_volts))
    assert "safe" in done.stdout, done.stderr
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)


def put_pipe(path: Path) -> None:
    os.mkfifo(path, 0o666)


def put_link(path: Path) -> None:
    target = path.with_name("target")
    target.write_text("not for everybody")
    path.symlink_to(target)


def put_link_to_nothing(path: Path) -> None:
    path.symlink_to(path.with_name("nothing"))


def put_foreign_file(path: Path) -> None:
    path.write_text("somebody's")
    path.chmod(0o644)
    os.chown(path, 65534, 65534)


TRICKS = [put_pipe, put_link, put_link_to_nothing, pytest.param(put_foreign_file, marks=as_root)]


def assert_untouched(path: Path) -> None:
    assert not path.with_name("nothing").exists()
    if (target := path.with_name("target")).exists():
        assert target.read_text() == "not for everybody"


def test_a_daemon_refuses_a_fault_file_that_pamctl_did_not_make(shared):
    path = shared / f"pamctl-{DEVICE}.fault"
    put_link(path)
    done = run_verb("daemon", "--socket", shared / "d.sock", *ON_DEVICE)
    assert done.returncode == 69, done.stderr
    assert str(path) in done.stderr.splitlines()[-1]
    assert "not for everybody" not in done.stderr
    assert_untouched(path)


@pytest.mark.parametrize("put", TRICKS)
def test_no_file_that_pamctl_did_not_make_is_opened(shared, put):
    path = shared / f"pamctl-{DEVICE}.ao"
    put(path)
    for use in (lambda: open_shared(path, 8), lambda: Latch(path)):
        with pytest.raises(RigError, match=re.escape(str(path))):
            use()
    assert_untouched(path)


def test_a_run_refuses_a_lock_that_pamctl_did_not_make(shared, monkeypatch):
    monkeypatch.setattr(backends, "SHARED_MEMORY", shared)
    path = shared / f"pamctl-{DEVICE}.lock"
    put_link_to_nothing(path)
    with (
        pytest.raises(RigError, match=re.escape(str(path))),
        backends.secure_device(resolve(overrides=[ON_DEVICE[1]]).rig),
    ):
        pytest.fail("the device was had")
    assert_untouched(path)


def test_no_ring_that_pamctl_did_not_make_stops_a_start(shared):
    for put in (put_pipe, put_link, put_link_to_nothing):
        put(shared / f"pamctl-1-{put.__name__}.ring")
    finish_orphans(shared, quiet=True)
    assert_untouched(shared / "a.ring")


@pytest.mark.parametrize("put", TRICKS)
@pytest.mark.parametrize("open_ring", [Ring.attach, Ring.watch])
def test_a_ring_is_never_a_pipe_a_link_or_another_users(shared, put, open_ring):
    put(shared / "a.ring")
    with pytest.raises(RingError):
        open_ring(shared / "a.ring")


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


def test_a_process_that_wants_to_run_and_cannot_is_starved():
    with starved() as pid:
        await_true(lambda: judge_after(pid, 0.05))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may run a process as SCHED_FIFO")
def test_a_process_that_computes_for_ever_is_not_starved():
    first = "os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    with process(BUSY.format(setup=first)) as pid:
        await_true(lambda: not judge_after(pid, 0.05))


def test_a_process_that_sleeps_or_is_stopped_is_not_starved():
    with process("import time; print(flush=True); time.sleep(600)") as pid:
        assert not judge_after(pid, 0.02)
    with starved() as pid:
        os.kill(pid, signal.SIGSTOP)
        await_true(lambda: Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2][1] == "T")
        assert not judge_after(pid, 0.02)


def test_a_process_that_is_gone_is_not_starved():
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


def test_a_starved_loop_is_given_time_and_then_called_starved(silent_ring):
    with starved() as pid:
        fault = find_fault(Silence(silent_ring, pid, 20 * MS, 200 * MS))
    if "starved" in fault:
        assert float(fault.split()[-2]) >= 200
    else:  # the busy machine let it run for a moment, just when it was judged
        assert "silent" in fault


def test_a_loop_that_is_stopped_is_given_no_more_time_than_before(silent_ring):
    with process("import time; print(flush=True); time.sleep(600)") as pid:
        os.kill(pid, signal.SIGSTOP)
        fault = find_fault(Silence(silent_ring, pid, 20 * MS, 3600_000 * MS))
    assert fault.startswith("the loop was silent for ")
