"""The guardian's decisions: by a made-up clock, and over processes that stand for the loop."""

import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.made_up import START_MONO_NS, meta
from support.patience import PATIENCE_S

from hal.rig import RigError
from pamctl.base.errors import Ending, ExitCode
from pamctl.processes import guardian, guardian_main
from pamctl.processes.front import Guardianship
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
from pamctl.realtime.clock import LoopSettings
from pamctl.recording.journal import SessionJournal
from pamctl.recording.ring import LoopStage, Ring
from pamctl.settings.resolve import ConfigError, resolve

MS = 1_000_000
LIMIT_NS = 50 * MS


# --- how silence is measured -------------------------------------------------------------


def measure_silences(looks: list[tuple[float, float]]) -> list[float]:
    """Let a listener look at (time, beat) in ms; return the silences it measures, in ms."""
    (first_ms, beat_ms), *rest = looks
    listener = Listener(round(first_ms * MS), round(beat_ms * MS))
    return [
        listener.measure_silence_ns(round(now * MS), round(beat * MS)) / MS for now, beat in rest
    ]


def test_a_frozen_loop_is_heard_as_silent_for_as_long_as_it_is():
    silences = measure_silences([(0, 0), *((t, 3.0) for t in range(POLL_MS, 101, POLL_MS))])
    assert silences[-1] == pytest.approx(97.0)


@pytest.mark.parametrize("stall_ms", [60, 500, 60_000])
def test_a_machine_that_stood_still_does_not_make_the_loop_a_frozen_one(stall_ms: float) -> None:
    # The guardian wakes first, and finds the heartbeat as old as the stall.
    silences = measure_silences(
        [(0, 0), (5, 4.6), (10 + stall_ms, 9.6), (15 + stall_ms, 14.6 + stall_ms)]
    )
    assert max(silences) <= 2 * POLL_MS


def test_a_beat_from_just_after_the_clock_was_read_is_no_negative_silence():
    assert measure_silences([(0, 0), (5, 5.1)]) == [0.0]


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
def test_milliseconds_count_only_while_the_loop_drives_the_valve(stage, done, expected_ns):
    assert patience_ns(stage, done, LIMIT_NS) == expected_ns


def test_a_limit_that_every_tick_would_exceed_is_refused():
    with pytest.raises(ConfigError, match="less than three periods of 10 ms"):
        resolve(overrides=["rig.loop.rate_hz=100", "rig.loop.heartbeat_ms=25"])


# --- the guardian within this process, its loop a process of ours -------------------------


class StubRig:
    """Refuses to be made safe a few times, like a card whose owner is still dying."""

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


@contextmanager
def frozen_loop() -> Iterator[subprocess.Popen[bytes]]:
    """Yield a stopped process: on no machine, however busy, does it wait for a CPU."""
    with sleeper() as process:
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        yield process


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[Ring]:
    with Ring.create(tmp_path / "test.ring", meta(tmp_path / "run.mcap"), 256) as made:
        yield made


def after(seconds: float, do: Callable[[], object]) -> None:
    threading.Timer(seconds, do).start()


def guard_stub(ring: Ring, pid: int, rig: StubRig) -> Takeover | None:
    return guard(ring, LoopProcess(pid), rig, LIMIT_NS)  # type: ignore[arg-type]


def test_a_death_is_noticed_at_once_and_a_busy_output_tried_again(ring):
    with sleeper() as loop:
        after(0.05, loop.kill)
        takeover = guard_stub(ring, loop.pid, StubRig(refusals=3))
    assert takeover is not None
    assert takeover.reason == ""
    assert takeover.failure == ""
    assert 0.0 < takeover.latency_ms < PATIENCE_S * 1e3
    assert takeover.event()["reason"] == "died"


def test_a_silent_loop_is_killed(ring):
    rig = StubRig()
    ring.loop_stage = LoopStage.TICKING
    with frozen_loop() as loop:
        takeover = guard_stub(ring, loop.pid, rig)
        assert loop.wait(PATIENCE_S) == -signal.SIGKILL
    assert takeover is not None
    assert "silent for" in takeover.reason
    assert rig.tries == 1


def test_a_loop_that_sets_up_or_leaves_may_take_its_time(ring):
    for stage in (LoopStage.SETTING_UP, LoopStage.LEAVING):
        ring.loop_stage = stage
        with sleeper() as loop:
            after(0.3, loop.kill)
            takeover = guard_stub(ring, loop.pid, StubRig())
            assert takeover is not None
            assert takeover.reason == ""  # it died; nobody killed it for its silence


def test_an_orderly_end_leaves_nothing_to_say_and_the_voltage_verified(ring):
    rig = StubRig()
    with sleeper() as loop:
        ring.loop_done = 1
        after(0.02, loop.kill)
        assert guard_stub(ring, loop.pid, rig) is None
    assert rig.tries == 1


def test_a_loop_that_is_gone_before_it_is_watched_is_a_dead_loop(ring):
    with sleeper() as loop:
        pass
    takeover = guard_stub(ring, loop.pid, StubRig())
    assert takeover is not None


def test_what_cannot_be_made_safe_says_why_when_patience_ends():
    failure = drive_safe(StubRig(refusals=10**9), patience_s=0.05)  # type: ignore[arg-type]
    assert "reserved" in str(failure)


def start_guardian() -> subprocess.Popen[bytes]:
    """Start a process that stays until its front lets it go."""
    return subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def test_a_guardian_that_dies_is_lost_when_the_front_looks(ring):
    guardian = start_guardian()
    front = Guardianship(ring, guardian, StubRig(), LoopSettings())  # type: ignore[arg-type]
    with sleeper() as loop:
        front.look(loop)
        assert not ring.guardian_lost
        os.kill(guardian.pid, signal.SIGKILL)
        os.waitid(os.P_PID, guardian.pid, os.WEXITED | os.WNOWAIT)
        front.look(loop)
        assert ring.guardian_lost
        assert loop.poll() is None
    front.dismiss()


def kill_silent_loop(ring: Ring, rig: StubRig, told: Ending) -> Ending:
    """Let the front kill a silent loop whose guardian is frozen; return its judgement."""
    guardian = start_guardian()
    front = Guardianship(ring, guardian, rig, LoopSettings())  # type: ignore[arg-type]
    ring.loop_stage = LoopStage.TICKING
    with frozen_loop() as loop:
        deadline_s = time.monotonic() + PATIENCE_S
        while loop.poll() is None:
            assert time.monotonic() < deadline_s
            front.look(loop)
            time.sleep(1e-3)
    os.kill(guardian.pid, signal.SIGSTOP)
    ending = front.judge_ending(told)
    front.dismiss()
    return ending


def test_a_silent_loop_that_its_guardian_leaves_alone_is_killed_by_the_front(ring):
    rig = StubRig()
    ending = kill_silent_loop(ring, rig, Ending(ExitCode.UNEXPECTED, "the loop process was killed"))
    assert ending.code == ExitCode.UNEXPECTED
    assert "the loop process was killed" not in ending.reason
    (silent_ms,) = re.findall(r"silent for (\d+) ms, its guardian did nothing", ending.reason)
    assert int(silent_ms) >= LoopSettings().heartbeat_ms + 40.0, "the guardian acts before it"
    assert "the front drove the safe voltage" in ending.reason
    assert rig.tries == 1


def test_a_killed_loop_that_waits_for_a_cpu_to_die_on_is_not_called_starved(ring, monkeypatch):
    """A process that is killed is runnable until it dies, and a busy PC makes it wait."""
    watchman, kills = start_guardian(), []
    front = Guardianship(ring, watchman, StubRig(), LoopSettings())  # type: ignore[arg-type]
    ring.loop_stage = LoopStage.TICKING
    with frozen_loop() as loop:
        late = SimpleNamespace(pid=loop.pid, poll=lambda: None, kill=lambda: kills.append(1))
        while not kills:
            front.look(late)  # type: ignore[arg-type]
            time.sleep(1e-3)
        monkeypatch.setattr(guardian, "read_state", lambda pid: "R")
        for _ in range(50):
            front.look(late)  # type: ignore[arg-type]
            time.sleep(1e-3)
    os.kill(watchman.pid, signal.SIGSTOP)
    assert "silent for" in front.judge_ending(Ending(ExitCode.UNEXPECTED, "killed")).reason
    assert kills == [1]
    front.dismiss()


def test_a_device_error_that_the_loop_has_told_stays_the_reason_of_its_end(ring):
    told = Ending(ExitCode.UNAVAILABLE, "device error -201003")
    ending = kill_silent_loop(ring, StubRig(), told)
    assert ending.code == ExitCode.UNAVAILABLE
    assert ending.reason.startswith("device error -201003; the loop was ")
    assert ending.reason.count("its guardian did nothing") == 1


def test_a_session_whose_driver_opens_slowly_is_not_taken_for_silent(tmp_path):
    with Ring.create(tmp_path / "a.ring", meta(tmp_path / "a.mcap"), 64) as ring:
        journal = SessionJournal(ring, lambda recorded: None)
        journal.note_start({"event": "timing_setup"})
        before_s = patience_ns(ring.loop_stage, False, 50_000_000) * 1e-9
        journal.put_event(0, START_MONO_NS, {"event": "rig"})
        after_s = patience_ns(ring.loop_stage, False, 50_000_000) * 1e-9
    assert before_s > 10.0
    assert after_s == 0.05


def test_a_watchman_that_does_not_start_is_not_waited_for_and_is_named(monkeypatch):
    monkeypatch.setattr(guardian_main, "STARTS_WITHIN_S", 0.1)
    monkeypatch.setattr(guardian_main, "child_command", lambda *_: ["sleep", "1000"])
    watchman = guardian_main.keep_watchman(resolve().rig, StubRig())  # type: ignore[arg-type]
    with pytest.raises(RigError, match=r"watchman process did not start within 0\.1 s"), watchman:
        pytest.fail("the work began without a watchman")
