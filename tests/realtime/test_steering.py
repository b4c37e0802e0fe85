"""A loop that takes orders begins a run without a long tick, and loses none."""

import sys
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.made_up import meta, tick
from support.runs import pack_row

from hal.calibration import Zero
from pamctl.base.errors import Ending, ExitCode
from pamctl.kernel.calls import PlainCall
from pamctl.realtime.run_ticks import start_loop
from pamctl.realtime.steering import SteeredProgram
from pamctl.realtime.tick import first_state
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.journal import SessionJournal
from pamctl.recording.ring import LoopStage, Ring
from pamctl.recording.rows import RowKind
from pamctl.settings.build import build_ordered_program, build_tick_setup
from pamctl.settings.resolve import resolve
from pamctl.signals import Phase, TickRecord

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="rings need Linux")

ROWS = 2048
"""A megabyte."""
SETTINGS = resolve()
SETUP = build_tick_setup(SETTINGS)
STATE = first_state(SETUP, Zero(0.0, 0.0))


class Slot:
    """Orders from a list."""

    def __init__(self) -> None:
        self.orders: list[dict[str, Any]] = []

    def take(self) -> dict[str, Any] | None:
        return self.orders.pop(0) if self.orders else None


def done_tick(record: TickRecord) -> TickRunner:
    """Return what the loop holds of a tick."""
    done = TickRunner(SETUP, PlainCall)
    done.take_over(
        start_loop(STATE, 0, 0)._replace(
            timing=record.timing,
            raw=record.raw,
            reference=record.reference,
            decision=record.decision,
        )
    )
    return done


class Session:
    """A session's journal and program, ticked by hand."""

    def __init__(self, folder: Path) -> None:
        self.slot = Slot()
        self.ring = Ring.create(folder / "a.session", meta(folder / "none"), 256)
        self.journal = SessionJournal(self.ring, lambda ring: None)
        self.program = SteeredProgram(
            self.slot,
            self.journal,
            SETUP,
            SETTINGS.controller.model_dump(mode="json"),
            lambda order: build_ordered_program(SETTINGS, order),
        )
        self.ticked = 0

    def tick(self) -> bool:
        """Do what the loop does with a tick that is computed; return False where it is to end."""
        record = tick(self.ticked)
        reference, _ = self.program.next_reference(record.timing.t_s, record.raw)
        if reference is None:
            return False
        self.ticked += 1
        self.journal.put_row(pack_row(record), record.timing.late_s, record.timing.missed)
        self.program.finish_tick(done_tick(record))
        return True

    def tick_until_recorded(self) -> int:
        """Tick until a run is recorded; return how many ticks that took."""
        before = self.ticked
        while self.journal.run is None:
            assert self.ticked - before < 1000
            self.tick()
        return self.ticked - before


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return Session(tmp_path)


def order_run(ring: Ring) -> dict[str, Any]:
    experiment = SETTINGS.experiment.model_dump(mode="json")
    return {"do": "run", "ring": str(ring.path), "experiment": experiment, "duration_s": None}


def make_ring(folder: Path, name: str) -> Ring:
    fields = tuple(f"f{i}" for i in range(len(_frozen())))
    return Ring.create(folder / name, meta(folder / "a.mcap", keyframe_fields=fields), ROWS)


def _frozen() -> tuple[float, ...]:
    from pamctl.realtime.tick import freeze_state

    return tuple(freeze_state(STATE))


def ticks_in(ring: Ring) -> list[int]:
    entries = ring.drain(ROWS).entries()
    return [entry.tick for entry in entries if entry.kind == RowKind.TICK]


def test_a_ring_is_attached_over_many_ticks_and_not_in_one(tmp_path, session, monkeypatch):
    touched: list[int] = []
    populate = Ring.populate_in_steps

    def watch(ring: Ring, *sizes: int) -> Any:
        for _ in populate(ring, *sizes):
            touched.append(session.ticked)
            yield

    with make_ring(tmp_path, "run.ring") as ring:
        monkeypatch.setattr(Ring, "populate_in_steps", watch)
        session.slot.orders.append(order_run(ring))
        took = session.tick_until_recorded()
        size = ring.path.stat().st_size
        assert touched == sorted(set(touched)), "at most one piece in a tick"
        assert len(touched) == -(-size // (64 * 4096))
        assert took == len(touched) + 2, "one tick to map it, one to begin"
        assert ring.loop_stage == LoopStage.TICKING


def test_the_ticks_of_two_runs_in_a_row_are_all_recorded(tmp_path, session):
    """The first run goes on while the ring of the second is attached."""
    session.journal.note_start({"event": "timing_setup"})
    with make_ring(tmp_path, "one.ring") as one, make_ring(tmp_path, "two.ring") as two:
        session.slot.orders.append(order_run(one))
        session.tick_until_recorded()
        first = session.ticked
        session.slot.orders.append(order_run(two))
        while not one.loop_done:
            session.tick()
        switch = session.ticked
        for _ in range(20):
            session.tick()
        assert ticks_in(one) == list(range(first, switch))
        assert ticks_in(two) == list(range(switch, switch + 20))
        begins = [entry for entry in two.drain(ROWS).entries() if entry.kind != RowKind.TICK]
        assert b"timing_setup" in begins[0].payload
        before = switch - 1, tick(switch - 1).raw.encoder_t_ns
        assert {(entry.tick, entry.t_ns) for entry in begins} == {before}


def test_the_ring_of_a_run_that_is_over_is_given_back_in_pieces_with_its_rows_intact(
    tmp_path, session
):
    def resident_bytes(name: str) -> int:
        """Return how much of a mapping of this process is in its memory."""
        parts = Path("/proc/self/smaps").read_text().split(name)[1:]
        return 1024 * sum(int(part.split("Rss:")[1].split()[0]) for part in parts)

    with make_ring(tmp_path, "one.ring") as one, make_ring(tmp_path, "two.ring") as two:
        before = resident_bytes("one.ring")  # mapped here once already, by its maker
        session.slot.orders.append(order_run(one))
        session.tick_until_recorded()
        first = session.ticked
        assert resident_bytes("one.ring") > before
        session.slot.orders.append(order_run(two))
        while not one.loop_done:
            session.tick()
        held = [resident_bytes("one.ring")]
        while held[-1] > before:
            session.tick()
            held.append(resident_bytes("one.ring"))
        largest = max(a - b for a, b in pairwise(held))
        assert largest <= 64 * 4096, "at most one piece in a tick"
        assert ticks_in(one)[0] == first


def test_an_order_that_follows_a_run_holds_for_that_run(tmp_path, session):
    stop: Mapping[str, Any] = {"do": "stop", "reason": "stopped by a client"}
    with make_ring(tmp_path, "run.ring") as ring:
        session.slot.orders += [order_run(ring), dict(stop)]
        session.tick_until_recorded()
        session.tick()
        events = [entry for entry in ring.drain(ROWS).entries() if entry.kind == RowKind.EVENT]
        assert b"stopped by a client" in events[-1].payload


def test_a_loop_that_leaves_ends_its_run_with_its_own_reason(tmp_path, session):
    with make_ring(tmp_path, "run.ring") as ring:
        session.slot.orders.append(order_run(ring))
        session.tick_until_recorded()
        session.tick()
        session.program.begin_stop(session.ticked * 1e-3, 0.0)
        while session.tick():
            assert session.ticked < 5000
        session.journal.end_last_run(Ending(ExitCode.OK, "told to leave"))
        (outcome,) = [e for e in ring.drain(ROWS).entries() if b'"outcome"' in e.payload]
        assert b"told to leave" in outcome.payload


def test_a_motion_that_would_go_on_in_a_log_that_has_just_ended_does_not_begin(session):
    """No log would have its ticks, and nobody could stop it: nothing runs any more."""
    hold = {"kind": "hold", "position_mm": 5.0}
    session.slot.orders.append({"do": "run", "ring": None, "experiment": hold, "duration_s": None})
    for _ in range(3):
        session.tick()
    assert session.slot.orders == []
    record = tick(session.ticked)
    reference, _ = session.program.next_reference(record.timing.t_s, record.raw)
    assert reference is not None
    assert reference.phase == Phase.OPEN_LOOP
