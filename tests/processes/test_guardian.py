"""The guardian: decisions with a made-up clock, deeds with real processes and signals."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from support.killing import kill_as_one
from support.made_up import meta
from support.patience import BUSY_PC, PATIENCE_S
from support.rings import await_ring, await_tick

from hal.rig import RigError, open_rig
from hal.sim.register import SharedRegister, peek_v
from hal.sim.sim_rig import SimRig, SimSettings, sensor_chain
from pamctl.exit_codes import Ending, ExitCode
from pamctl.log.reader import read
from pamctl.plant.model import plant_parameters
from pamctl.plant.simulated import SimulatedPlant
from pamctl.processes.backends import ao_path, build_clock, build_rig
from pamctl.processes.guardian import (
    LEAVING_NS,
    POLL_MS,
    SETTING_UP_NS,
    Listener,
    LoopProcess,
    Takeover,
    drive_safe,
    guard,
    patience_ns,
)
from pamctl.processes.guardian_handle import Guardianship
from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.loop_settings import LoopSettings
from pamctl.recording.ring import LoopStage, RecorderFlag, Ring
from pamctl.settings.resolve import ConfigError, resolve
from pamctl.signals import Phase

MS = 1_000_000
LIMIT_NS = 50 * MS
SAFE_V = 0.0
AO_STEP_V = 20.0 / 65536.0
PYTHON = [sys.executable, "-m"]
OFF_ITS_SAFE_VOLTAGE = ["rig.homing.enabled=false", "experiment.frequency_hz=0.005"]
"""The valve is at 5 V from the first tick on, for longer than the busiest PC needs to look."""


# --- how silence is measured -------------------------------------------------------------


def heard(looks: list[tuple[float, float]]) -> list[float]:
    """Let a listener look at (time, beat) in ms; return the silence it tells, in ms."""
    (first_ms, beat_ms), *rest = looks
    listener = Listener(round(first_ms * MS), round(beat_ms * MS))
    return [
        listener.measure_silence_ns(round(now * MS), round(beat * MS)) / MS for now, beat in rest
    ]


def test_a_loop_that_beats_is_never_silent_for_longer_than_between_two_looks() -> None:
    silences = heard([(t, t - 0.4) for t in range(0, 1000, POLL_MS)])
    assert max(silences) == pytest.approx(0.4)


def test_a_frozen_loop_is_heard_as_silent_for_as_long_as_it_is() -> None:
    silences = heard([(0, 0), *((t, 3.0) for t in range(POLL_MS, 101, POLL_MS))])
    assert silences[-1] == pytest.approx(97.0)


@pytest.mark.parametrize("stall_ms", [60, 500, 60_000])
def test_a_machine_that_stood_still_does_not_make_the_loop_a_frozen_one(stall_ms: float) -> None:
    # The guardian wakes first, and finds the heartbeat as old as the stall.
    silences = heard([(0, 0), (5, 4.6), (10 + stall_ms, 9.6), (15 + stall_ms, 14.6 + stall_ms)])
    assert max(silences) <= 2 * POLL_MS


def test_two_stalls_in_a_row_are_not_a_freeze() -> None:
    assert max(heard([(0, 0), (5, 4.6), (65, 9.6), (125, 9.7), (130, 129.6)])) < 50


def test_a_guardian_that_is_always_late_still_hears_a_frozen_loop_in_the_end() -> None:
    silences = heard([(0, 0), *((30.0 * look, 0.0) for look in range(1, 10))])
    assert silences[-1] > 50


def test_a_beat_from_just_after_the_clock_was_read_is_no_negative_silence() -> None:
    assert heard([(0, 0), (5, 5.1)]) == [0.0]


@pytest.mark.parametrize(
    ("stage", "done", "expected_ns"),
    [
        (LoopStage.SETTING_UP, False, SETTING_UP_NS),
        (LoopStage.TICKING, False, LIMIT_NS),
        (LoopStage.LEAVING, False, LEAVING_NS),
        (LoopStage.TICKING, True, LEAVING_NS),
        (LoopStage.SETTING_UP, True, LEAVING_NS),
    ],
)
def test_milliseconds_count_only_while_the_loop_drives_the_valve(
    stage: int, done: bool, expected_ns: int
) -> None:
    assert patience_ns(stage, done, LIMIT_NS) == expected_ns


def test_a_limit_that_every_tick_would_exceed_is_refused() -> None:
    with pytest.raises(ConfigError, match="less than three periods of 10 ms"):
        resolve(overrides=["rig.loop.rate_hz=100", "rig.loop.heartbeat_ms=25"])


# --- the guardian within this process, its loop a process of ours -------------------------


class StubRig:
    """Refuses to be made safe a few times, as a card whose owner is just dying."""

    def __init__(self, refusals: int = 0) -> None:
        self.refusals = refusals
        self.tries = 0

    def make_safe(self) -> None:
        self.tries += 1

    @property
    def safe_failure(self) -> RigError | None:
        return RigError("the output is reserved") if self.tries <= self.refusals else None


@contextmanager
def sleeper() -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(["sleep", "60"])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[Ring]:
    with Ring.create(tmp_path / "test.ring", meta(tmp_path / "run.mcap"), 256) as made:
        yield made


def after(seconds: float, do: Callable[[], object]) -> None:
    threading.Timer(seconds, do).start()


def guarded(ring: Ring, pid: int, rig: StubRig) -> Takeover | None:
    return guard(ring, LoopProcess(pid), rig, LIMIT_NS)  # type: ignore[arg-type]


def test_a_death_is_noticed_at_once_and_a_busy_output_tried_again(ring: Ring) -> None:
    with sleeper() as loop:
        after(0.05, loop.kill)
        takeover = guarded(ring, loop.pid, StubRig(refusals=3))
    assert takeover is not None
    assert takeover.reason == ""
    assert takeover.failure == ""
    assert takeover.event()["reason"] == "died"


def test_a_silent_loop_is_killed(ring: Ring) -> None:
    rig = StubRig()
    ring.loop_stage = LoopStage.TICKING
    with sleeper() as loop:
        takeover = guarded(ring, loop.pid, rig)
        assert loop.wait(PATIENCE_S) == -signal.SIGKILL
    assert takeover is not None
    assert "silent for" in takeover.reason
    assert rig.tries == 1


def test_a_loop_that_sets_up_or_leaves_may_take_its_time(ring: Ring) -> None:
    for stage in (LoopStage.SETTING_UP, LoopStage.LEAVING):
        ring.loop_stage = stage
        with sleeper() as loop:
            after(0.3, loop.kill)
            takeover = guarded(ring, loop.pid, StubRig())
            assert takeover is not None
            assert takeover.reason == ""  # it died; nobody killed it for its silence


def test_an_orderly_end_leaves_nothing_to_say_and_the_voltage_verified(ring: Ring) -> None:
    rig = StubRig()
    with sleeper() as loop:
        ring.loop_done = 1
        after(0.02, loop.kill)
        assert guarded(ring, loop.pid, rig) is None
    assert rig.tries == 1


def test_a_loop_that_is_gone_before_it_is_watched_is_a_dead_loop(ring: Ring) -> None:
    with sleeper() as loop:
        pass
    takeover = guarded(ring, loop.pid, StubRig())
    assert takeover is not None


def test_what_cannot_be_made_safe_says_why_when_patience_ends() -> None:
    failure = drive_safe(StubRig(refusals=10**9), patience_s=0.05)  # type: ignore[arg-type]
    assert "reserved" in str(failure)


def test_a_guardian_that_dies_is_lost_when_the_front_looks(ring: Ring) -> None:
    front = Guardianship(ring, ["sh", "-c", "read line", "guardian"], StubRig(), LoopSettings())  # type: ignore[arg-type]
    with sleeper() as loop:
        front.look(loop)
        assert not ring.guardian_lost
        assert front.pid
        os.kill(front.pid, signal.SIGKILL)
        os.waitid(os.P_PID, front.pid, os.WEXITED | os.WNOWAIT)
        front.look(loop)
        assert ring.guardian_lost
        assert loop.poll() is None
    front.dismiss()


def test_a_silent_loop_that_its_guardian_leaves_alone_is_killed_by_the_front(ring: Ring) -> None:
    rig = StubRig()
    front = Guardianship(ring, ["sh", "-c", "read line", "guardian"], rig, LoopSettings())  # type: ignore[arg-type]
    ring.loop_stage = LoopStage.TICKING
    with sleeper() as loop:
        deadline_s = time.monotonic() + PATIENCE_S
        while loop.poll() is None:
            assert time.monotonic() < deadline_s
            front.look(loop)
            time.sleep(1e-3)
    assert front.pid
    os.kill(front.pid, signal.SIGSTOP)
    ending = front.judge_ending(Ending(ExitCode.UNEXPECTED, "the loop process was killed"))
    assert ending.code == ExitCode.UNEXPECTED
    assert "its guardian did nothing" in ending.reason
    assert "the front drove the safe voltage" in ending.reason
    assert rig.tries == 1
    front.dismiss()


# --- what the loop hears of the others ----------------------------------------------------


def supervised(ring: Ring, front_fd: int | None = None, *, patient: bool = False) -> LoopSupervisor:
    return LoopSupervisor(
        ring, front_fd, LoopSettings(ring_rows=256, stop_ramp_s=0.01), patient=patient
    )


def asked(supervisor: LoopSupervisor, ms: int) -> tuple[str, bool] | None:
    """Ask at 1 kHz for so long; return the reason to stop, and whether at once."""
    for tick in range(ms):
        at_once = supervisor.wants_abort()
        wanted = supervisor.find_stop(tick)
        if wanted is not None:
            return wanted.reason, at_once
    return None


def test_a_guardian_that_stands_still_is_found_within_the_heartbeat_and_ends_the_run_at_once(
    ring: Ring,
) -> None:
    supervisor = supervised(ring)
    for _ in range(100):
        ring.guardian_beats += 1
        assert asked(supervisor, 8) is None
    assert asked(supervisor, 40) is None
    assert asked(supervisor, 24) == ("the guardian gives no sign of life", True)


def test_where_there_is_no_clock_there_is_no_guardian_to_miss(ring: Ring) -> None:
    assert asked(supervised(ring, patient=True), 2000) is None


@pytest.mark.parametrize("who", ["guardian", "front", "recorder"])
def test_the_death_of_any_other_process_ends_the_run_at_once(ring: Ring, who: str) -> None:
    ours, theirs = os.pipe()
    supervisor = supervised(ring, ours)
    assert asked(supervisor, 8) is None
    match who:
        case "guardian":
            ring.guardian_lost = 1
        case "front":
            os.close(theirs)
        case "recorder":
            ring.raise_flag(RecorderFlag.FAILED)
    found = asked(supervisor, 8)
    assert found is not None
    assert found[1]
    os.close(ours)
    if who != "front":
        os.close(theirs)


def test_during_a_smooth_stop_a_death_still_ends_the_run_at_once(ring: Ring) -> None:
    supervisor = supervised(ring)
    supervisor._on_signal(signal.SIGINT, None)
    assert asked(supervisor, 8) == ("stopped by SIGINT", False)
    ring.guardian_lost = 1
    assert any(supervisor.wants_abort() for _ in range(8))


def test_a_full_disk_leaves_time_for_a_smooth_stop(ring: Ring) -> None:
    supervisor = supervised(ring)
    ring.raise_flag(RecorderFlag.FAILED | RecorderFlag.DISK_FULL)
    assert asked(supervisor, 8) == ("the log's disk is full", False)


# --- the shared output --------------------------------------------------------------------


def shared_rig(path: Path) -> SimRig:
    settings = resolve(fast=True)
    return SimRig(
        SimulatedPlant(plant_parameters(settings.plant)),
        sensor_chain(SimSettings(), settings.rig.calibration),
        safe_output_v=1.25,
        now_ns=time.monotonic_ns,
        register=SharedRegister(path, "bench0"),
    )


def test_an_output_holds_its_voltage_after_its_owner_and_can_then_be_made_safe(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bench0.ao"
    owner = (
        "import sys, time; sys.path.insert(0, sys.argv[2])\n"
        "from pathlib import Path; from test_guardian import shared_rig\n"
        "rig = shared_rig(Path(sys.argv[1])); rig.open(); rig.write(8.0)\n"
        "print('there', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", owner, path, Path(__file__).parents[1]],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parent,
    ) as process:
        assert process.stdout
        process.stdout.readline()
        rig = shared_rig(path)
        with pytest.raises(RigError, match=f"bench0 is held by process {process.pid}"):
            rig.open()
        rig.make_safe()
        assert f"process {process.pid}" in str(rig.safe_failure)
        process.kill()
    assert peek_v(path) == pytest.approx(8.0, abs=AO_STEP_V)
    rig.make_safe()
    assert rig.safe_failure is None
    assert peek_v(path) == pytest.approx(1.25, abs=AO_STEP_V)


def test_what_another_process_puts_out_is_what_moves_the_muscle(tmp_path: Path) -> None:
    path = tmp_path / "bench0.ao"
    with open_rig(shared_rig(path)) as rig:
        rig.write(5.0)
        at_rest = rig.read().encoder_counts
        np.memmap(path, dtype=float, mode="r+", shape=(1,))[0] = 10.0
        deadline_s = time.monotonic() + PATIENCE_S
        while rig.read().encoder_counts == at_rest:
            assert time.monotonic() < deadline_s, "the muscle does not fill"
    assert peek_v(path) == pytest.approx(1.25, abs=AO_STEP_V)


def test_a_run_without_a_clock_has_no_shared_output() -> None:
    settings = resolve(fast=True, overrides=["rig.sim.device=never0"])
    with open_rig(build_rig(settings, build_clock(settings, may_spin=False)).rig):
        assert not ao_path("never0").exists()


# --- real runs, real signals --------------------------------------------------------------


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
        deadline_s = time.monotonic() + PATIENCE_S
        while abs(self.output_v - SAFE_V) > AO_STEP_V:
            assert time.monotonic() < deadline_s, f"still {self.output_v} V"
            time.sleep(1e-3)


def run_command(device: str, *arguments: str) -> list[str]:
    settings = [
        f"rig.sim.device={device}", *OFF_ITS_SAFE_VOLTAGE, *BUSY_PC
    ]  # fmt: skip
    options = [part for setting in settings for part in ("--set", setting)]
    return [*PYTHON, "pamctl", "run", "--experiment", "square-1", *options, *arguments]


@contextmanager
def running(cwd: Path, device: str, log: str = "run.mcap") -> Iterator[Run]:
    """Run in real time until the block ends; whatever is left then is killed."""
    front = subprocess.Popen(
        run_command(device, "--quiet", "--log", log),
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    run = Run(front, {"front": front.pid}, device, cwd / log)
    try:
        run.pids.update(_parts(front.pid))
        yield run
    finally:
        for pid in run.pids.values():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        front.communicate()
        await_gone(*run.pids.values())


PARTS = ("loop_main", "guardian_main", "recorder")


def _parts(front: int) -> dict[str, int]:
    deadline_s = time.monotonic() + PATIENCE_S
    found: dict[str, int] = {}
    while len(found) < len(PARTS):
        assert time.monotonic() < deadline_s, f"the front started only {found}"
        time.sleep(0.02)
        for pid in Path(f"/proc/{front}/task/{front}/children").read_text().split():
            command = Path(f"/proc/{pid}/cmdline").read_text()
            found |= {name: int(pid) for name in PARTS if f".{name}\0" in command}
    return found


def await_motion(run: Run) -> None:
    """Return somewhere in the experiment, with the valve off its safe voltage."""
    await_tick(run.front.pid, lambda tick: tick["applied_v"] > 1.0)
    time.sleep(random.uniform(0.0, 0.5))
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


def assert_next_start_is_clean(cwd: Path, device: str) -> None:
    done = subprocess.run(
        run_command(device, "--duration", "0.1", "--log", "next.mcap", "--json"),
        cwd=cwd, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["log_is_whole"]
    assert peek_v(ao_path(device)) == pytest.approx(SAFE_V, abs=AO_STEP_V)


def takeovers(run: Run) -> list[dict[str, object]]:
    return [event for event in read(run.log).events if event["event"] == "guardian_takeover"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_loop_that_dies_or_freezes_leaves_the_valve_safe_and_the_log_complete(
    tmp_path: Path, device: str, number: signal.Signals
) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        os.kill(run.pids["loop_main"], number)
        run.await_safe()
        _, said = run.front.communicate(timeout=PATIENCE_S)
    assert run.front.returncode == 1
    assert "the guardian drove the safe voltage" in said
    assert ("killed by SIGKILL" if number == signal.SIGKILL else "silent for") in said
    assert len(takeovers(run)) == 1
    assert_log_complete_to(run, before)


@pytest.mark.parametrize("first", ["loop_main", "guardian_main"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_frozen_loop_without_a_guardian_is_ended_by_the_front(
    tmp_path: Path, device: str, first: str, number: signal.Signals
) -> None:
    faults = {"loop_main": signal.SIGSTOP, "guardian_main": number}
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        for name in sorted(faults, key=lambda name: name != first):
            os.kill(run.pids[name], faults[name])
        run.await_safe()
        _, said = run.front.communicate(timeout=PATIENCE_S)
        await_gone(*run.pids.values())
    assert run.front.returncode == 1
    # A loop that is frozen a moment after its guardian may have noticed that in between.
    if "the front killed it" in said:
        assert "the front drove the safe voltage" in said
        assert [e["event"] for e in read(run.log).events].count("front_takeover") == 1
    else:
        assert first == "guardian_main"
        assert "the guardian " in said
    assert_log_complete_to(run, before)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_without_its_guardian_a_loop_stops_safe(
    tmp_path: Path, device: str, number: signal.Signals
) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        os.kill(run.pids["guardian_main"], number)
        run.await_safe()
        _, said = run.front.communicate(timeout=PATIENCE_S)
    assert run.front.returncode == 1
    assert "the guardian " in said  # is gone, or gives no sign of life: who notices first
    assert_stopped_at_once(run)
    assert_log_complete_to(run, before)


def test_without_its_front_a_loop_stops_safe_and_the_guardian_leaves_after_it(
    tmp_path: Path, device: str
) -> None:
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


def test_without_its_recorder_a_loop_stops_safe_and_the_front_finishes_the_log(
    tmp_path: Path, device: str
) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        os.kill(run.pids["recorder"], signal.SIGKILL)
        run.await_safe()
        _, said = run.front.communicate(timeout=PATIENCE_S)
    assert run.front.returncode == 1
    assert "finished from the ring" in said
    assert_stopped_at_once(run)
    assert_log_complete_to(run, before)


def assert_stopped_at_once(run: Run) -> None:
    """See that nobody took the time for the ramp of a smooth stop, which is 500 ticks long."""
    assert np.count_nonzero(read(run.log)["phase"] == Phase.STOPPING) == 0


def await_gone(*pids: int) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        assert time.monotonic() < deadline_s, "a process was left behind"
        time.sleep(0.02)


def test_a_front_that_is_stopped_for_a_while_harms_nobody(tmp_path: Path, device: str) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        os.kill(run.front.pid, signal.SIGSTOP)
        time.sleep(0.5)
        before = last_tick_put(run)
        os.kill(run.front.pid, signal.SIGCONT)
        run.front.send_signal(signal.SIGINT)
        run.front.communicate(timeout=PATIENCE_S)
        assert run.front.returncode == 130
        assert run.output_v == pytest.approx(SAFE_V, abs=AO_STEP_V)
    assert not takeovers(run)
    assert_log_complete_to(run, before)


def test_loop_and_guardian_killed_together_are_made_good_by_the_front(
    tmp_path: Path, device: str
) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        for name in ("guardian_main", "loop_main"):
            os.kill(run.pids[name], signal.SIGKILL)
        run.await_safe()
        run.front.communicate(timeout=PATIENCE_S)
    assert run.front.returncode == 1


def test_loop_and_front_killed_together_leave_a_safe_valve_and_a_log_with_its_end(
    tmp_path: Path, device: str
) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        for name in ("front", "loop_main"):
            os.kill(run.pids[name], signal.SIGKILL)
        run.await_safe()
        run.front.wait()
        await_gone(run.pids["guardian_main"], run.pids["recorder"])
    assert len(takeovers(run)) == 1
    assert read(run.log).events[-1]["event"] == "outcome"


def test_after_everything_was_killed_at_once_pamctl_safe_closes_the_valve(
    tmp_path: Path, device: str
) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        before = last_tick_put(run)
        kill_as_one(*run.pids.values())
        run.front.wait()
        await_gone(run.pids["loop_main"])
        assert run.output_v > 1.0  # it holds, as a card does
        done = safe(device)
        assert done.returncode == 0, done.stderr
        assert "safe" in done.stdout
        assert run.output_v == pytest.approx(SAFE_V, abs=AO_STEP_V)
    time.sleep(2.1)  # a ring younger than that might belong to a run that is just starting
    assert_next_start_is_clean(tmp_path, device)
    assert_log_complete_to(run, before)


def safe(device: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [*PYTHON, "pamctl", "safe", "--set", f"rig.sim.device={device}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_a_device_in_use_is_refused_to_a_second_run_and_to_pamctl_safe(
    tmp_path: Path, device: str
) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        second = subprocess.run(
            run_command(device, "--log", "second.mcap"),
            cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert second.returncode == 69
        assert f"{device} is held by process {run.front.pid}" in second.stderr
        assert len(second.stderr.splitlines()) == 1
        assert not (tmp_path / "second.mcap").exists()
        refused = safe(device, "--json")
        assert refused.returncode == 69
        assert f"held by process {run.pids['loop_main']}" in json.loads(refused.stdout)["reason"]
        assert run.front.poll() is None
        run.front.send_signal(signal.SIGINT)
        run.front.communicate(timeout=PATIENCE_S)
        assert run.front.returncode == 130


def test_runs_without_a_clock_do_not_get_into_each_others_way(tmp_path: Path) -> None:
    device = f"test{os.getpid()}-nobodys"
    options = ["--fast", "--duration", "2", "--quiet"]
    commands = [run_command(device, *options, "--log", f"{i}.mcap") for i in range(2)]
    runs = [
        subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL) for command in commands
    ]
    assert [run.wait(PATIENCE_S) for run in runs] == [0, 0]
    assert not ao_path(device).exists()


def test_signals_do_not_end_a_guardian_before_its_loop(tmp_path: Path, device: str) -> None:
    with running(tmp_path, device) as run:
        await_motion(run)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(run.pids["guardian_main"], number)
        time.sleep(0.2)
        os.kill(run.pids["loop_main"], signal.SIGKILL)
        run.await_safe()
        run.front.communicate(timeout=PATIENCE_S)
    assert len(takeovers(run)) == 1
