"""The protocol between front, loop, guardian and recorder: explored, and compared with the code."""

import json
import os
import signal
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.made_up import meta
from support.processes import protocol_model as model
from support.processes.protocol_model import RULES, BrokenPromiseError, Life, Rules, explore

from hal.rig import RigError
from pamctl.base.errors import Ending, ExitCode
from pamctl.processes import front, guardian
from pamctl.processes.front import Guardianship
from pamctl.processes.guardian import Silence, Takeover
from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.clock import LoopSettings
from pamctl.recording import journal
from pamctl.recording.ring import LoopStage, RecorderFlag, Ring

MS = 1_000_000
DIED = Ending(ExitCode.UNEXPECTED, "the loop process was killed by SIGKILL")


@pytest.mark.long
def test_every_interleaving_of_three_deaths_and_freezes_keeps_the_promises():
    assert len(explore()) > 100_000


@pytest.mark.parametrize(
    ("mutant", "promise", "events"),
    [
        # The hole that was found by breaking real runs.
        ({"front_listens": False}, "the valve is open", {"loop frozen", "guardian frozen"}),
        ({"guardian_listens": False}, "the valve is open", {"loop frozen", "front dead"}),
        ({"loop_hears_guardian": False}, "the valve is open", {"guardian frozen"}),
        ({"loop_sees_front": False}, "the valve is open", {"front dead"}),
        ({"front_kills_first": False}, "two writers", {"loop dead", "guardian frozen"}),
        ({"guardian_stays": False}, "the log waits", {"recorder dead", "front dead"}),
        ({"finisher_kills": False}, "waits for ever", {"recorder frozen", "front dead"}),
        ({"ring_waits": False}, "rows are lost", {"loop dead"}),
    ],
)
def test_a_model_without_one_of_its_mechanisms_breaks_a_promise(mutant, promise, events):
    with pytest.raises(BrokenPromiseError, match=promise) as broken:
        explore(RULES._replace(most_faults=len(events), **mutant))
    assert {event for event in broken.value.path if " " in event} == events


# --- the code's transitions, beside the model's --------------------------------------------


class StubRig:
    """Counts how often the safe voltage is driven."""

    tries = 0
    safe_failure: RigError | None = None

    def make_safe(self) -> None:
        self.tries += 1


class StubProcess:
    """A process as its parent sees it."""

    def __init__(self, life: Life = Life.RUNS) -> None:
        self.life = life
        self.pid = os.getpid()
        self.stdin = self.stdout = None

    def poll(self) -> int | None:
        return None if self.life in (Life.RUNS, Life.FROZEN) else -signal.SIGKILL

    def kill(self) -> None:
        self.life = Life.DEAD


class StubClock:
    """A clock that stands still until it is moved."""

    now_ns = 1_000 * MS

    def monotonic_ns(self) -> int:
        return self.now_ns

    def monotonic(self) -> float:
        return self.now_ns * 1e-9

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[Ring]:
    with Ring.create(tmp_path / "test.ring", meta(tmp_path / "run.mcap"), 256) as made:
        yield made


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> StubClock:
    made = StubClock()
    monkeypatch.setattr(guardian, "time", made)
    monkeypatch.setattr(front, "time", made)
    return made


HEARTBEAT_MS, GUARDIAN_STEPS, FRONT_STEPS = 20.0, 2, 6
"""A step is 10 ms here: the front waits for 40 ms longer than the guardian."""
STEPS = Rules(guardian_patience=GUARDIAN_STEPS, front_patience=FRONT_STEPS)


def test_a_silence_ends_the_loop_exactly_when_the_model_says_so(clock, ring):
    ring.loop_stage = LoopStage.TICKING
    for beats in product([True, False], repeat=7):
        ring.loop_beat_ns = clock.now_ns
        silence = Silence(ring, 0, round(HEARTBEAT_MS * MS), 0)
        age, found, expected = 0, [], []
        for beat in beats:
            if beat:
                ring.loop_beat_ns, age = clock.now_ns, 0
            for _ in range(2):
                clock.sleep(5e-3)
                fault = silence.find_fault()
            age += 1
            found.append(bool(fault))
            silent = model.is_too_silent(
                STEPS, loop_age=age, is_leaving=False, listens_from=GUARDIAN_STEPS
            )
            expected.append(silent)
        assert found == expected, beats


@pytest.mark.parametrize("guardian_life", [Life.RUNS, Life.FROZEN, Life.DEAD])
@pytest.mark.parametrize("loop_life", [Life.RUNS, Life.FROZEN, Life.DEAD])
def test_the_front_looks_as_the_model_does(clock, ring, loop_life, guardian_life):
    ring.loop_stage = LoopStage.TICKING
    ring.loop_beat_ns = clock.now_ns
    handle = make_handle(ring, StubRig(), guardian_life)
    loop = StubProcess(loop_life)
    state = model.with_life(model.State(), model.LOOP, loop_life)
    state = model.with_life(state, model.GUARDIAN, guardian_life)
    handle.look(loop)  # type: ignore[arg-type]
    for _ in range(FRONT_STEPS + 3):
        if loop_life == Life.RUNS:
            ring.loop_beat_ns = clock.now_ns
            state = state._replace(loop_age=0)
        for _ in range(2):
            clock.sleep(5e-3)
            handle.look(loop)  # type: ignore[arg-type]
        state = state._replace(loop_age=state.loop_age + 1)
        if state.front_phase == model.Phase.WATCHING:
            state = model.move_front(STEPS, state)
        assert (loop.poll() is not None) == model.loop_ended(state)
        assert bool(ring.guardian_lost) == state.guardian_lost


def make_handle(ring: Ring, rig: StubRig, life: Life) -> Guardianship:
    """Return the front's side of a guardian that is a stub."""
    pace = LoopSettings(heartbeat_ms=HEARTBEAT_MS)
    return Guardianship(ring, StubProcess(life), rig, pace)  # type: ignore[arg-type]


@pytest.mark.parametrize("has_reported", [True, False])
@pytest.mark.parametrize("life", [Life.RUNS, Life.FROZEN, Life.DEAD])
def test_the_front_judges_an_ending_as_the_model_does(monkeypatch, clock, ring, life, has_reported):
    """A running guardian that says nothing: first the safe voltage, then the front takes over."""
    ring.loop_stage = LoopStage.TICKING
    rig = StubRig()
    handle = make_handle(ring, rig, life)
    process: Any = handle._process
    said = Takeover("", 1.0, 1.0, "")._asdict() if has_reported else None
    line = json.dumps(said).encode() + b"\n" if said else b""
    process.stdout = SimpleNamespace(readline=lambda: line)
    waits = []

    def select(*arguments: object) -> tuple[list[object], ...]:
        clock.sleep(arguments[3])  # type: ignore[arg-type]
        waits.append(rig.tries)
        # The end of a dead guardian's pipe is readable, too.
        return ([process.stdout] if line or life == Life.DEAD else []), [], []

    monkeypatch.setattr(front, "select", SimpleNamespace(select=select))
    monkeypatch.setattr(
        front, "read_state", lambda pid: "T" if process.life == Life.FROZEN else "S"
    )
    ending = handle.judge_ending(DIED)

    verdicts = []
    for waited in range(RULES.report_patience + 2):
        verdicts.append(model.judge(RULES, has_reported=has_reported, guardian=life, waited=waited))
        if verdicts[-1] in ("believe", "take over"):
            break
    takes_over = verdicts[-1] == "take over"
    assert ("the front drove" in ending.reason) == takes_over
    assert ("the guardian drove" in ending.reason) != takes_over
    assert (process.life == Life.DEAD) == (takes_over or life == Life.DEAD)
    # Before it gives the guardian up, the front has driven the safe voltage itself.
    assert (waits[-1] > 0) == ("make safe" in verdicts)
    assert rig.tries == ("make safe" in verdicts) + takes_over


@pytest.mark.parametrize("recorder_failed", [True, False])
@pytest.mark.parametrize("guardian_lost", [True, False])
@pytest.mark.parametrize("guardian_age", range(5))
@pytest.mark.parametrize("front_gone", [True, False])
def test_the_loop_aborts_when_the_model_says_so(
    ring, recorder_failed, guardian_lost, guardian_age, front_gone
):
    ours, theirs = os.pipe()
    try:
        # A step is a look here, every 8 ms; three of them are longer than the heartbeat.
        pace = LoopSettings(ring_rows=256, stop_ramp_s=0.01, heartbeat_ms=20.0)
        rules = RULES._replace(loop_patience=3)
        supervisor = LoopSupervisor(ring, ours, pace)
        assert not ask_for_a_look(supervisor)
        if recorder_failed:
            ring.raise_flag(RecorderFlag.FAILED)
        ring.guardian_lost = int(guardian_lost)
        if front_gone:
            os.close(theirs)
        ring.guardian_beats += 1
        looks = [ask_for_a_look(supervisor) for _ in range(guardian_age + 1)]
        expected = [
            model.loop_aborts(
                rules,
                recorder_failed=recorder_failed,
                guardian_lost=guardian_lost,
                guardian_age=age,
                front_gone=front_gone,
            )
            for age in range(guardian_age + 1)
        ]
        assert looks == expected
        stop = supervisor.find_stop(0)
        assert (stop is not None and stop.code == ExitCode.UNEXPECTED) == looks[-1]
    finally:
        os.close(ours)
        if not front_gone:
            os.close(theirs)


def ask_for_a_look(supervisor: LoopSupervisor) -> bool:
    """Ask at 1 kHz until the supervisor has looked once more."""
    return [supervisor.wants_abort() for _ in range(8)][-1]


def test_the_loop_stops_for_a_silent_recorder_as_the_model_says(monkeypatch, ring):
    clock = StubClock()
    monkeypatch.setattr(journal, "time", clock)
    step_s = journal.SILENT_RECORDER_S / RULES.recorder_patience
    supervisor = LoopSupervisor(ring, None, LoopSettings(ring_rows=256, stop_ramp_s=0.01))
    supervisor.watch_recording(ring)
    for beats in range(2 * RULES.recorder_patience):
        ring.recorder_beats, ring.guardian_beats = beats, beats
        assert not ask_for_a_look(supervisor)
        assert supervisor.find_stop(0) is None
        clock.sleep(0.999 * step_s)
    ring.recorder_beats += 1
    for age in range(RULES.recorder_patience + 3):
        ring.guardian_beats += 1
        assert not ask_for_a_look(supervisor)
        stop = supervisor.find_stop(0)
        assert (stop is not None) == model.loop_stops(RULES, recorder_age=age)
        clock.sleep(0.999 * step_s)
