"""Real processes of a run are killed and frozen: the valve is safe, and the log is complete.

The rig is simulated. Over the card's stand-in: `test_card_runs.py`. All faults: `test_protocol.py`.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from standin.standin import require_compiler
from support.command_line import run_pamctl, start_process
from support.patience import BUSY_PC, PATIENCE_S, await_true
from support.processes.children import PARTS, await_children, await_gone
from support.processes.killing import kill_as_one
from support.processes.rings import age_ring, await_ring, await_tick, ring_left
from support.runs import AO_STEP_V

from hal.sim import peek_v
from pamctl.log.reader import read
from pamctl.processes.backends import ao_path
from pamctl.recording.ring import Ring
from pamctl.signals import Phase

SAFE_V = 0.0
PYTHON = [sys.executable, "-m"]
OFF_ITS_SAFE_VOLTAGE = ["rig.homing.enabled=false", "experiment.frequency_hz=0.005"]
"""The valve is at 5 V from the first tick on, for longer than a very busy PC needs to look."""


@pytest.fixture(scope="module")
def device() -> Iterator[str]:
    """A simulated device, on which each run is the next start after the death before it."""
    name = f"test{os.getpid()}-{random.randrange(10**6)}"
    yield name
    for suffix in ("ao", "lock"):
        ao_path(name).with_suffix(f".{suffix}").unlink(missing_ok=True)


class Run(NamedTuple):
    """A real run, and the process ids of its parts."""

    front: subprocess.Popen[str]
    pids: dict[str, int]
    device: str
    log: Path

    @property
    def output_v(self) -> float:
        return peek_v(ao_path(self.device))

    def await_safe(self) -> None:
        await_true(lambda: abs(self.output_v - SAFE_V) <= AO_STEP_V, "not safe", 1e-3)


def run_command(device: str, *arguments: str) -> list[str]:
    settings = [
        f"rig.sim.device={device}", *OFF_ITS_SAFE_VOLTAGE, *BUSY_PC
    ]  # fmt: skip
    options = [part for setting in settings for part in ("--set", setting)]
    return [*PYTHON, "pamctl", "run", "--experiment", "square-1", *options, *arguments]


@contextmanager
def running(cwd: Path, device: str, log: str = "run.mcap") -> Iterator[Run]:
    """Run in real time until the block ends; whatever is left then is killed."""
    front = start_process(run_command(device, "--quiet", "--log", log), cwd=cwd)
    run = Run(front, {"front": front.pid}, device, cwd / log)
    try:
        run.pids.update(await_children(front.pid, *PARTS))
        yield run
    finally:
        for pid in run.pids.values():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        front.communicate()
        await_gone(*run.pids.values())


def await_motion(run: Run) -> None:
    """Return somewhere in the experiment, with the valve off its safe voltage."""
    await_tick(run.front.pid, lambda tick: tick["applied_v"] > 1.0)
    time.sleep(random.uniform(0.0, 0.1))
    assert run.output_v > 1.0


def last_tick_put(run: Run) -> int:
    with Ring.attach(await_ring(run.front.pid)) as ring:
        tick = ring.latest_tick()
        assert tick
        return int(tick["tick"])


def assert_log_complete_to(run: Run, tick: int) -> None:
    log = read(run.log)
    assert np.array_equal(np.diff(log["tick"]) - 1, log["missed"][1:])
    assert log["tick"][-1] >= tick


def assert_next_start_finishes(run: Run, ring: Path, cwd: Path, device: str) -> None:
    command = run_command(device, "--fast", "--duration", "0.1", "--log", "next.mcap", "--json")
    done = run_pamctl(*command[3:], cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert f"an earlier run died ({ring}): finished {run.log}" in done.stderr
    assert not ring.exists()
    assert json.loads(done.stdout)["log_is_whole"]


def takeovers(run: Run) -> list[dict[str, object]]:
    return [event for event in read(run.log).events if event["event"] == "guardian_takeover"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_loop_that_dies_or_freezes_leaves_the_valve_safe_and_the_log_complete(
    tmp_path, device, number
):
    with running(tmp_path, device) as run:
        await_motion(run)
        for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(run.pids["guardian_main"], ignored)
        before = last_tick_put(run)
        os.kill(run.pids["loop_main"], number)
        run.await_safe()
        _, said = run.front.communicate(timeout=PATIENCE_S)
    assert run.front.returncode == 1
    assert "the guardian drove the safe voltage" in said
    assert ("killed by SIGKILL" if number == signal.SIGKILL else "silent for") in said
    assert len(takeovers(run)) == 1
    assert_log_complete_to(run, before)


def test_without_its_guardian_a_loop_stops_safe(tmp_path, device):
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        os.kill(run.pids["guardian_main"], signal.SIGSTOP)
        run.await_safe()
        _, said = run.front.communicate(timeout=PATIENCE_S)
    assert run.front.returncode == 1
    assert "the guardian " in said  # is gone, or gives no sign of life: who notices first
    assert_stopped_at_once(run)
    assert_log_complete_to(run, before)


def test_without_its_front_a_loop_stops_safe_and_the_guardian_leaves_after_it(tmp_path, device):
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        run.front.kill()
        run.front.wait()
        run.await_safe()
        await_gone(run.pids["loop_main"], run.pids["guardian_main"], run.pids["recorder"])
        assert not takeovers(run)
    assert_stopped_at_once(run)
    assert_log_complete_to(run, before)


def test_without_its_recorder_a_loop_stops_safe_and_the_front_finishes_the_log(tmp_path, device):
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        os.kill(run.pids["recorder"], signal.SIGKILL)
        run.await_safe()
        _, said = run.front.communicate(timeout=PATIENCE_S)
    assert run.front.returncode == 1
    assert "finished from the ring" in said
    assert not ring_left(run.front.pid)
    assert_stopped_at_once(run)
    assert_log_complete_to(run, before)
    assert read(run.log).events[-1]["reason"] == "the recorder failed"


def assert_stopped_at_once(run: Run) -> None:
    """Check that the loop skipped the ramp of a smooth stop, which is 500 ticks long."""
    assert np.count_nonzero(read(run.log)["phase"] == Phase.STOPPING) == 0


@pytest.mark.long
def test_loop_and_front_killed_together_leave_a_safe_valve_and_a_log_with_its_end(tmp_path, device):
    with running(tmp_path, device) as run:
        await_motion(run)
        for name in ("front", "loop_main"):
            os.kill(run.pids[name], signal.SIGKILL)
        run.await_safe()
        run.front.wait()
        await_gone(run.pids["guardian_main"], run.pids["recorder"])
    assert len(takeovers(run)) == 1
    assert read(run.log).events[-1]["event"] == "outcome"


@pytest.mark.long
def test_after_everything_was_killed_at_once_pamctl_safe_closes_the_valve(tmp_path, device):
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        ring = await_ring(run.front.pid)
        kill_as_one(*run.pids.values())
        run.front.wait()
        await_gone(run.pids["loop_main"])
        assert run.output_v > 1.0  # it holds, as a card does
        done = run_pamctl("safe", "--set", f"rig.sim.device={device}")
        assert done.returncode == 0, done.stderr
        assert "safe" in done.stdout
        assert run.output_v == pytest.approx(SAFE_V, abs=AO_STEP_V)
    age_ring(ring)
    assert_next_start_finishes(run, ring, tmp_path, device)
    assert_log_complete_to(run, before)


@pytest.mark.long
def test_a_device_in_use_is_refused_and_a_front_that_was_stopped_goes_on(tmp_path, device):
    with running(tmp_path, device) as run:
        await_motion(run)
        os.kill(run.front.pid, signal.SIGSTOP)
        second = run_pamctl(*run_command(device, "--log", "second.mcap")[3:], cwd=tmp_path)
        assert second.returncode == 69
        assert f"{device} is held by process {run.front.pid}" in second.stderr
        assert len(second.stderr.splitlines()) == 1
        assert not (tmp_path / "second.mcap").exists()
        refused = run_pamctl("safe", "--set", f"rig.sim.device={device}", "--json")
        assert refused.returncode == 69
        assert f"held by process {run.pids['loop_main']}" in json.loads(refused.stdout)["reason"]
        before = last_tick_put(run)
        os.kill(run.front.pid, signal.SIGCONT)
        run.front.send_signal(signal.SIGINT)
        run.front.communicate(timeout=PATIENCE_S)
        assert run.front.returncode == 130
        assert run.output_v == pytest.approx(SAFE_V, abs=AO_STEP_V)
    assert not takeovers(run)
    assert_log_complete_to(run, before)


@pytest.mark.long
def test_runs_without_a_clock_share_a_device_and_the_next_one_finishes_the_log_of_a_killed_one(
    tmp_path,
):
    device, log = f"test{os.getpid()}-nobodys", tmp_path / "killed.mcap"
    short = run_command(device, "--fast", "--duration", "0.1", "--quiet")[3:]
    run = subprocess.Popen(run_command(device, "--fast", "--quiet", "--log", str(log)))
    try:
        await_true(lambda: log.exists() and log.stat().st_size >= 1 << 20)
        assert run_pamctl(*short, "--log", "beside.mcap", cwd=tmp_path).returncode == 0
        assert run.poll() is None
        assert not ao_path(device).exists()
    finally:
        run.kill()
        run.wait()
    ring = await_ring(run.pid)
    with Ring.attach(ring) as left:
        last = left.latest_tick()
    age_ring(ring)
    assert run_pamctl(*short, "--log", "next.mcap", cwd=tmp_path).returncode == 0
    assert not ring.exists()
    assert last is not None
    assert read(log)["tick"].tolist() == list(range(int(last["tick"]) + 1))


# --- rounds of faults, as scripts/fault_rounds.py makes them -------------------------------------

WELL = {"safe_after_ms": 3.0, "ticks_lost": 0}
ROUNDS = [("sim loop killed", WELL), ("sim loop frozen", {"amiss": "8 V"})]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "scripts")
    import fault_rounds

    return fault_rounds


def test_what_was_done_before_ctrl_c_is_told_kept_and_not_done_again(
    script, monkeypatch, tmp_path, capsys
):
    kept = tmp_path / "faults.jsonl"
    monkeypatch.setattr("sys.argv", ["fault_rounds.py", "--resume", str(kept)])

    def stopped(count, done, hits, names, drawn):
        yield from ROUNDS
        raise KeyboardInterrupt

    monkeypatch.setattr(script, "rounds", stopped)
    assert script.main() == 130
    said = capsys.readouterr()
    assert "safe after 3.0 ms" in said.err
    assert "AMISS: 8 V" in said.err
    assert json.loads(said.out)["stopped"]
    assert json.loads(said.out)["cases"]["sim loop frozen"]["amiss"] == ["8 V"]

    with kept.open("a") as file:
        file.write('{"case": "sim lo')  # killed while it wrote
    asked = []
    monkeypatch.setattr(script, "rounds", lambda count, done, *_: asked.append(done) or ())
    assert script.main() == 3
    assert asked == [{"sim loop killed": 1, "sim loop frozen": 1}]
    assert json.loads(capsys.readouterr().out)["cases"]["sim loop killed"]["well"] == 1


# --- real processes -------------------------------------------------------------------------

HARDEST = [
    # Nobody but the front is left to see it.
    ("nidaq", ("guardian", "frozen"), ("loop", "frozen")),
    # Nobody is left who knows the ring but a guardian, or a loop: they start a finisher.
    ("daemon", ("front", "killed"), ("recorder", "frozen")),
    # The loop ends because its guardian is gone, and the front dies just after it.
    ("sim", ("guardian", "killed"), ("recorder", "killed"), ("front", "killed")),
]


@pytest.mark.long
@pytest.mark.parametrize("case", HARDEST, ids=lambda case: " ".join(sum(case[1:], case[:1])))
def test_a_real_run_keeps_its_promises_whichever_processes_are_hit(
    script, monkeypatch, tmp_path, case
):
    require_compiler()
    name, *faults = case
    monkeypatch.setattr(script, "PATIENCE_S", PATIENCE_S)
    monkeypatch.setattr(script, "OPTIONS", [*script.OPTIONS, *BUSY_PC])
    with script.benches(tmp_path) as rigs:
        bench = next(rig for rig in rigs if rig.name == name)
        found = script.round_of(bench, faults, tmp_path / "run.mcap")
    assert found["ticks_lost"] == 0
    if case == HARDEST[0]:
        told = [event["event"] for event in read(tmp_path / "run.mcap").events]
        assert told.count("front_takeover") == 1
