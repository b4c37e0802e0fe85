"""Every step towards real time is taken, or says how to allow it; and every step is undone."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pamctl.realtime import scheduling
from pamctl.realtime.scheduling import PreparationStep, SchedulingError, prepare

ROOT = Path(__file__).parents[2]
linux_only = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has these steps")
root_only = pytest.mark.skipif(
    sys.platform != "linux" or os.geteuid() != 0,
    reason="only root can become another user, or is sure of its permissions",
)


def in_fresh_process(script: str) -> Any:
    """The JSON that a script prints: real steps would change the test process for good."""
    run = subprocess.run(
        [sys.executable, "-c", PREAMBLE + script],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=30,
    )
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
def test_what_is_permitted_is_done_and_release_undoes_it() -> None:
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
def test_the_loop_runs_on_the_cpu_asked_for() -> None:
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
def test_auto_goes_on_with_a_clear_line_where_a_user_is_refused() -> None:
    seen = in_fresh_process(
        """
become_nobody()
with prepare("auto") as preparation:
    print(json.dumps([preparation.fifo, preparation.may_spin, preparation.as_metadata()]))
"""
    )
    fifo, may_spin, metadata = seen
    assert not fifo
    assert not may_spin
    assert metadata["mode"] == "auto"
    assert metadata["fifo"].startswith("not done: Operation not permitted; RLIMIT_RTPRIO is 0: put")
    assert metadata["fifo"].endswith("LimitRTPRIO=80 into the service unit")
    assert "memlock unlimited" in metadata["mlock"]
    assert metadata["timer_slack"] == "done: timer slack 1 ns"
    assert metadata["gc"].startswith("done:")
    assert all("\n" not in line for line in metadata.values())


@root_only
def test_require_fails_with_every_refused_step_and_undoes_the_others() -> None:
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


@root_only
def test_the_timer_slack_is_restored() -> None:
    seen = in_fresh_process(
        """
become_nobody()
import ctypes
slack_ns = lambda: ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)
before_ns = slack_ns()
with prepare("auto"):
    during_ns = slack_ns()
print(json.dumps([before_ns, during_ns, slack_ns()]))
"""
    )
    before_ns, during_ns, after_ns = seen
    assert during_ns == 1 < before_ns == after_ns


# Refused in pretence, in this process: the steps that would succeed are kept from doing anything.


@pytest.fixture
def nothing_is_permitted(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    for step in ("_lock_memory", "_keep_cpu_awake", "_pin", "_run_as_fifo", "_take_timer_slack"):
        monkeypatch.setattr(scheduling, step, refuse)


@linux_only
@pytest.mark.usefixtures("nothing_is_permitted")
def test_where_nothing_is_permitted_every_step_says_why() -> None:
    with prepare("auto") as preparation:
        refused = [step.name for step in preparation.refused]
        lines = [str(step) for step in preparation.refused]
    assert refused == ["mlock", "dma_latency", "affinity", "fifo", "timer_slack"]
    assert all("not done: Operation not permitted" in line for line in lines)


@linux_only
@pytest.mark.usefixtures("nothing_is_permitted")
def test_require_leaves_the_process_as_it_was() -> None:
    with pytest.raises(SchedulingError):
        prepare("require")
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


@linux_only
def test_a_single_cpu_is_not_pinned_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    for step in ("_lock_memory", "_keep_cpu_awake", "_run_as_fifo"):
        monkeypatch.setattr(scheduling, step, lambda _: "pretended")
    with prepare("auto") as preparation:
        (affinity,) = preparation.refused
    assert affinity.detail.startswith("only one CPU to run on")


def test_off_touches_nothing_but_the_garbage_collector() -> None:
    with prepare("off") as preparation:
        assert [step.name for step in preparation.steps] == ["gc"]
        assert not preparation.fifo
        assert not gc.isenabled()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_a_collector_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        prepare("off").release()
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_elsewhere_than_on_linux_every_step_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    with prepare("auto") as preparation:
        refused = preparation.refused
    assert {step.detail for step in refused} == {"only Linux offers this"}
    assert PreparationStep("fifo", False, "only Linux offers this") in refused


# The front.


@root_only
def test_a_front_preempts_ordinary_processes_while_it_watches_and_not_afterwards() -> None:
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
def test_a_front_without_privileges_watches_as_it_may() -> None:
    seen = in_fresh_process(
        """
become_nobody()
with raise_front_priority("auto"):
    print(json.dumps(state()["policy"]))
"""
    )
    assert seen == os.SCHED_OTHER
