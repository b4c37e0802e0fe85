"""Every step towards real time is taken, or says how to allow it; and every step is undone."""

import gc
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from support.command_line import run_process

from pamctl.realtime import scheduling
from pamctl.realtime.scheduling import PreparationStep, SchedulingError, prepare

ROOT = Path(__file__).parents[2]
linux_only = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has these steps")
root_only = pytest.mark.skipif(
    sys.platform != "linux" or os.geteuid() != 0,
    reason="only root can become another user, or is sure of its permissions",
)


@pytest.fixture(autouse=True)
def _heap_of_all_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop collects its small heap once; here each step would go through that of all tests."""
    monkeypatch.setattr(gc, "collect", lambda *_: 0)


def in_fresh_process(script: str) -> Any:
    """The JSON that a script prints: real steps would change the test process for good."""
    run = run_process([sys.executable, "-c", PREAMBLE + script], cwd=ROOT)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


PREAMBLE = """
import gc, json, os, resource, subprocess, sys
from pathlib import Path
from pamctl.realtime.scheduling import SchedulingError, raise_front_priority, prepare

def state():
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {
        "policy": os.sched_getscheduler(0) & 0xFFFF,
        "locked_kib": int(status["VmLck"].split()[0]),
        "cpus": sorted(os.sched_getaffinity(0)),
        "files": sorted(os.readlink(link) for link in Path("/proc/self/fd").iterdir()
                        if link.is_symlink()),
        "gc": gc.isenabled(),
        "frozen": gc.get_freeze_count(),
    }

def become_nobody():
    for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
        resource.setrlimit(limit, (0, 0))
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
"""


# Permitted.


@root_only
def test_what_is_permitted_is_done_and_release_undoes_it():
    seen = in_fresh_process(
        """
before = state()
with prepare("auto") as preparation:
    steps = {step.name: step.done for step in preparation.steps}
    during = state()
    child = subprocess.run(
        [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"],
        capture_output=True, text=True,
    ).stdout
preparation.release()
print(json.dumps([steps, before, during, state(), int(child)]))
"""
    )
    steps, before, during, after, child_policy = seen
    if not steps["fifo"] or not steps["mlock"]:
        pytest.skip("this container refuses SCHED_FIFO or mlockall even to root")
    assert during["policy"] == os.SCHED_FIFO
    assert during["locked_kib"] > 1000
    assert not during["gc"]
    assert during["frozen"] > 0
    if steps["affinity"]:
        assert during["cpus"] == before["cpus"][-1:]
    if steps["dma_latency"]:
        assert "/dev/cpu_dma_latency" in during["files"]
    assert "timer_slack" not in steps, "SCHED_FIFO knows no timer slack"
    assert child_policy == os.SCHED_OTHER, "a child must not compete with the loop"
    assert after == before


@linux_only
def test_the_loop_runs_on_the_cpu_asked_for():
    cpus = sorted(os.sched_getaffinity(0))
    if len(cpus) < 2:
        pytest.skip("needs two CPUs")
    seen = in_fresh_process(
        f"""
with prepare("auto", cpu={cpus[0]}):
    print(json.dumps(state()["cpus"]))
"""
    )
    assert seen == cpus[:1]


# Refused for real: root becomes nobody, and has no rights left.


@root_only
def test_auto_goes_on_with_a_clear_line_where_a_user_is_refused_and_takes_what_is_left():
    seen = in_fresh_process(
        """
become_nobody()
import ctypes
state_ns = lambda: ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)
before_ns = state_ns()
with prepare("auto") as preparation:
    told = [preparation.fifo, preparation.may_spin, preparation.as_metadata()]
    during_ns = state_ns()
print(json.dumps([*told, before_ns, during_ns, state_ns()]))
"""
    )
    fifo, may_spin, metadata, before_ns, during_ns, after_ns = seen
    assert not fifo
    assert not may_spin
    assert metadata["mode"] == "auto"
    assert metadata["fifo"].startswith("not done: Operation not permitted; RLIMIT_RTPRIO is 0: put")
    assert metadata["fifo"].endswith("LimitRTPRIO=80 into the service unit")
    assert "memlock unlimited" in metadata["mlock"]
    assert metadata["timer_slack"] == "done: timer slack 1 ns"
    assert metadata["gc"].startswith("done:")
    assert all("\n" not in line for line in metadata.values())
    assert during_ns == 1 < before_ns
    assert after_ns == before_ns


@root_only
def test_require_fails_with_every_refused_step_and_undoes_the_others():
    seen = in_fresh_process(
        """
become_nobody()
before = state()
try:
    prepare("require")
except SchedulingError as refusal:
    print(json.dumps([str(refusal), [step.name for step in refusal.refused], before, state()]))
"""
    )
    message, refused, before, after = seen
    assert {"fifo", "mlock"} <= set(refused)
    assert message.startswith("real-time scheduling is required, but was refused:\n  mlock: ")
    assert "\n  fifo: Operation not permitted; RLIMIT_RTPRIO is 0" in message
    assert after == before


@linux_only
def test_a_process_that_is_confined_to_one_cpu_does_not_spin(monkeypatch):
    """The PC has several; a spinning loop would leave none to the others of its run."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    for step in ("_lock_memory", "_keep_cpu_awake", "_run_as_fifo"):
        monkeypatch.setattr(scheduling, step, lambda _: "pretended")
    allowed = {3}
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: allowed)
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cpus: None)
    with prepare("auto") as confined:
        assert confined.fifo
        assert not confined.may_spin
    allowed = {0, 3}
    with prepare("auto") as free:
        assert free.may_spin


# The threads of a driver.

DRIVER_THREADS = """
import threading, time
def start_threads():
    for _ in range(4):
        threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
    return sorted({int(task.name) for task in Path("/proc/self/task").iterdir()} - {os.getpid()})
def state_of(threads):
    return [[os.sched_getscheduler(one) & 0xFFFF, os.sched_getparam(one).sched_priority,
             sorted(os.sched_getaffinity(one))] for one in threads]
"""


@root_only
def test_the_threads_of_a_driver_are_raised_and_unpinned():
    seen = in_fresh_process(
        DRIVER_THREADS
        + """
cpus = sorted(os.sched_getaffinity(0))
with prepare("auto") as preparation:
    none = preparation.free_foreign_threads()
    threads = start_threads()
    before = state_of(threads)
    (step,) = preparation.free_foreign_threads()
    print(json.dumps([preparation.fifo, cpus, none, before, step, state_of(threads),
                      state_of([os.getpid()])]), flush=True)
    os._exit(0)
"""
    )
    fifo, cpus, none, before, step, after, loop = seen
    if not fifo:
        pytest.skip("this container refuses SCHED_FIFO even to root")
    assert none == []
    pinned = cpus[-1:]
    assert before == [[os.SCHED_OTHER, 0, pinned]] * 4, "what a driver's thread inherits"
    assert after == [[os.SCHED_FIFO, 1, cpus]] * 4
    assert loop == [[os.SCHED_FIFO, scheduling.PRIORITY, pinned]], "the loop stays as it was"
    assert step == [
        "foreign_threads",
        True,
        "4 of the driver's threads: SCHED_FIFO, priority 1, all CPUs",
    ]


@root_only
def test_threads_of_a_driver_that_may_not_be_raised_are_unpinned_and_named():
    seen = in_fresh_process(
        DRIVER_THREADS
        + """
become_nobody()
with prepare("auto") as preparation:
    threads = start_threads()
    (step,) = preparation.free_foreign_threads()
    print(json.dumps([sorted(preparation._cpus), step, state_of(threads)]), flush=True)
    os._exit(0)
"""
    )
    cpus, (_, done, detail), after = seen
    assert not done
    assert detail.startswith("4 of the driver's threads: Operation not permitted; ")
    assert after == [[os.SCHED_OTHER, 0, cpus]] * 4


# Refused in pretence, in this process: the steps that would succeed are kept from doing anything.


@pytest.fixture
def nothing_is_permitted(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    steps = ("_lock_memory", "_keep_cpu_awake", "_pin", "_run_as_fifo", "_take_timer_slack")
    for step in steps:
        monkeypatch.setattr(scheduling, step, refuse)


@linux_only
@pytest.mark.usefixtures("nothing_is_permitted")
def test_where_nothing_is_permitted_every_step_says_why():
    with prepare("auto") as preparation:
        refused = [step.name for step in preparation.refused]
        lines = [str(step) for step in preparation.refused]
    assert refused == ["mlock", "dma_latency", "affinity", "fifo", "timer_slack"]
    assert all("not done: Operation not permitted" in line for line in lines)


@linux_only
@pytest.mark.usefixtures("nothing_is_permitted")
def test_require_leaves_the_process_as_it_was():
    with pytest.raises(SchedulingError):
        prepare("require")
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


@linux_only
def test_a_single_cpu_is_not_pinned_and_says_so(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    for step in ("_lock_memory", "_keep_cpu_awake", "_run_as_fifo"):
        monkeypatch.setattr(scheduling, step, lambda _: "pretended")
    with prepare("auto") as preparation:
        (affinity,) = preparation.refused
    assert affinity.detail.startswith("only one CPU to run on")


def test_off_touches_nothing_but_the_garbage_collector():
    with prepare("off") as preparation:
        assert [step.name for step in preparation.steps] == ["gc"]
        assert not preparation.fifo
        assert not gc.isenabled()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_a_collector_that_was_off_stays_off():
    gc.disable()
    try:
        prepare("off").release()
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_elsewhere_than_on_linux_every_step_says_so(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    with prepare("auto") as preparation:
        refused = preparation.refused
    assert {step.detail for step in refused} == {"only Linux offers this"}
    assert PreparationStep("fifo", False, "only Linux offers this") in refused


# The front.


@root_only
def test_a_front_preempts_ordinary_processes_while_it_watches_and_not_afterwards():
    seen = in_fresh_process(
        """
seen = [state()["policy"]]
for mode in ("auto", "off"):
    with raise_front_priority(mode):
        seen.append(state()["policy"])
    seen.append(state()["policy"])
print(json.dumps(seen))
"""
    )
    assert seen == [os.SCHED_OTHER, os.SCHED_FIFO, os.SCHED_OTHER, os.SCHED_OTHER, os.SCHED_OTHER]


@root_only
def test_a_front_without_privileges_watches_as_it_may():
    seen = in_fresh_process(
        """
become_nobody()
with raise_front_priority("auto"):
    print(json.dumps(state()["policy"]))
"""
    )
    assert seen == os.SCHED_OTHER
