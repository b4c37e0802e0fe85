"""The loop's end of the ring: rows, signs of life, and the last words of a run.

A loop that outlives its runs has a ring, and so a log, for each of them. Between runs the ticks go
into the session's ring, which nobody reads. Heartbeat and worst lateness are always in the
session's ring, which the guardian watches while the loop lives.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress

from pamctl.base.errors import Ending
from pamctl.recording.ring import LoopStage, RecorderFlag, Ring, RingFull

SILENT_RECORDER_S = 3.0
"""A recorder without a sign of life for this time counts as dead."""

_ROOM_PATIENCE_S = 1.0


class StandStill:
    """Tells for how long something has stood still, such as the beats of a process."""

    def __init__(
        self, look: Callable[[], object], most_s: float = math.inf, lasted_s: float = 0.0
    ) -> None:
        """Begin now, after a stand-still of `lasted_s`.

        At most `most_s` count between two looks: a machine that stood still says nothing.
        """
        self._look, self._seen = look, look()
        self._most_s, self._lasted_s = most_s, lasted_s
        self._looked_s = time.monotonic()

    def lasts_s(self) -> float:
        """Look once more; return for how long nothing new was seen (s)."""
        now_s, seen = time.monotonic(), self._look()
        passed_s = min(now_s - self._looked_s, self._most_s)
        self._lasted_s = 0.0 if seen != self._seen else self._lasted_s + passed_s
        self._seen, self._looked_s = seen, now_s
        return self._lasted_s


class RingJournal:
    """Puts rows, and writes the loop's heartbeat and worst lateness into the ring's header.

    What puts a row raises `RingFull` if there is no room.
    """

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._watched = ring
        """The ring whose heartbeat the guardian watches."""
        self._worst_late_s = 0.0

    @property
    def run(self) -> Ring | None:
        """The ring of the current run."""
        return self._ring

    @property
    def start_ns(self) -> int:
        """When the run began, on the monotonic clock."""
        return self._ring.meta.start_mono_ns

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        """Put a tick that is packed already."""
        self._ring.put_row(row)
        self._show_life(late_s, missed)

    def put_rows(self, rows: memoryview) -> None:
        """Put many ticks that are packed already."""
        self._ring.put_rows(rows)
        self._watched.loop_beat_ns = time.monotonic_ns()

    def _show_life(self, late_s: float, missed: int) -> None:
        self._watched.loop_beat_ns = time.monotonic_ns()
        if late_s > self._worst_late_s:
            self._worst_late_s = late_s
            self._ring.worst_late_ns = round(late_s * 1e9)

    def rehearse_row(self, row: bytearray) -> None:
        """Do what `put_row` does, up to the point where others would see it."""
        self._ring.rehearse_row(row)

    def note_start(self, event: Mapping[str, object]) -> None:
        """Put an event before the rig is open: no heartbeat begins, as a driver may be slow."""
        self._ring.put_event(0, self.start_ns, event)
        self._watched.loop_beat_ns = time.monotonic_ns()

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Put an event. The first event, just before the first tick, starts the heartbeat."""
        self._ring.put_event(tick, t_ns, event)
        self._watched.loop_beat_ns = time.monotonic_ns()
        self._watched.loop_stage = LoopStage.TICKING

    def put_gains(self, tick: int, t_ns: int, gains: Mapping[str, object]) -> None:
        """Put gains that apply from the next tick on."""
        self._ring.put_gains(tick, t_ns, gains)

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Put the frozen state."""
        self._ring.put_keyframe(tick, t_ns, state)

    def end_ticks(self) -> None:
        """Tell the guardian to wait longer: releasing a card takes longer than a tick."""
        self._watched.loop_beat_ns = time.monotonic_ns()
        self._watched.loop_stage = LoopStage.LEAVING

    def end_last_run(self, ending: Ending) -> None:
        """Put the outcome behind the last tick of a run that goes on; wait a moment for room.

        Where there is none, the front puts it there once the recorder has made room.
        """
        deadline_s = time.monotonic() + _ROOM_PATIENCE_S
        while self.run is not None and not self.run.loop_done and time.monotonic() < deadline_s:
            try:
                put_last_event(self.run, make_outcome_event(ending))
                self.run.loop_done = 1
            except RingFull:
                time.sleep(5e-3)


def wait_for_recorder(ring: Ring) -> None:
    """Let a full ring wait for its recorder, in a run without a clock.

    It gives up if the recorder has failed or fallen silent.
    """

    def await_room(has_room: Callable[[], bool]) -> None:
        silence = StandStill(lambda: ring.recorder_beats)
        while not (has_room() or ring.recorder_flags & RecorderFlag.FAILED):
            if silence.lasts_s() > SILENT_RECORDER_S:
                return
            time.sleep(1e-3)
            ring.loop_beat_ns = time.monotonic_ns()

    ring.await_room = await_room


_FIRST_EVENTS = ("timing_setup", "rate_warning", "rig", "foreign_threads", "zeroed")
"""Events that begin the log of every run, repeated from when they were last put."""
_CLOSED = object()


class SessionJournal(RingJournal):
    """Puts rows into the ring of the current run, or else into the session's own ring."""

    def __init__(self, session: Ring, recorded: Callable[[Ring | None], None]) -> None:
        """Begin between runs; `recorded` gets the ring that has a recorder, or None."""
        super().__init__(session)
        self._session = session
        self._recorded = recorded
        self._standing: dict[str, Mapping[str, object]] = {}
        self._closing: deque[Iterator[None]] = deque()
        # Nobody reads the session's own ring: where it is full, its rows are old.
        session.await_room = lambda has_room: session.commit(session.head)

    @property
    def run(self) -> Ring | None:
        """The ring of the current run; None between runs."""
        return None if self._ring is self._session else self._ring

    def begin_run(
        self,
        ring: Ring,
        tick: int,
        t_ns: int,
        gains: Sequence[Mapping[str, object]],
        state: Sequence[float],
    ) -> None:
        """Switch to the new ring, and put first what a replay of its log needs.

        This includes the frozen state after `tick`, the last tick before this log.
        """
        for event in self._standing.values():
            ring.put_event(tick, t_ns, event)
        for said in gains:
            ring.put_gains(tick, t_ns, said)
        ring.put_keyframe(tick, t_ns, state)
        ring.loop_stage = LoopStage.TICKING
        self._ring, self._worst_late_s = ring, 0.0
        self._recorded(ring)

    def end_run(self, tick: int, t_ns: int, ending: Ending) -> None:
        """Put the run's outcome, and switch to the session's own ring."""
        ring = self._ring
        if ring is self._session:
            return
        self._recorded(None)
        ring.put_event(tick, t_ns, make_outcome_event(ending))
        ring.loop_done = 1
        self._closing.append(ring.close_in_steps())
        self._ring = self._session

    def close_a_little(self) -> None:
        """Take one step in closing the ring of a run that is over; called once a tick."""
        if self._closing and next(self._closing[0], _CLOSED) is _CLOSED:
            self._closing.popleft()

    def end_last_run(self, ending: Ending) -> None:
        """End the current run at its last tick, because the session ends."""
        super().end_last_run(ending)
        self._ring = self._session
        self._session.loop_done = 1

    def _show_life(self, late_s: float, missed: int) -> None:
        super()._show_life(late_s, missed)
        if self._ring is not self._session:
            self._ring.loop_beat_ns = self._session.loop_beat_ns
        if missed:
            self._ring.missed_ticks += missed

    def note_start(self, event: Mapping[str, object]) -> None:
        """Keep an event for the runs to come, before the rig is open."""
        self._standing[str(event["event"])] = event
        super().note_start(event)

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Put an event; those that begin a log are kept for the runs to come."""
        if event["event"] in _FIRST_EVENTS:
            self._standing[str(event["event"])] = event
        super().put_event(tick, t_ns, event)

    def put_event_text(self, tick: int, t_ns: int, text: bytes) -> None:
        """Put an event that is JSON already, and begins no log."""
        self._ring.put_event_text(tick, t_ns, text)

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Put the frozen state, during a run only."""
        if self._ring is not self._session:
            super().put_keyframe(tick, t_ns, state)


def make_outcome_event(ending: Ending) -> dict[str, object]:
    """Return the event that ends every run."""
    return {"event": "outcome", "code": int(ending.code), "reason": ending.reason}


def put_last_event(ring: Ring, event: Mapping[str, object]) -> None:
    """Put an event at the time of the last tick; raise `RingFull` if there is no room."""
    last = ring.latest_tick() or {"tick": 0, "encoder_t_ns": ring.meta.start_mono_ns}
    ring.put_event(int(last["tick"]), int(last["encoder_t_ns"]), event)


def end_for_dead_loop(ring: Ring, ending: Ending) -> None:
    """End the rows of a run whose loop has not done so: its recorder would wait for more."""
    if not ring.loop_done:
        put_event_for_dead_loop(ring, make_outcome_event(ending))
        ring.loop_done = 1


def put_event_for_dead_loop(ring: Ring, event: Mapping[str, object]) -> None:
    """Put an event for a dead loop; a ring must have only one producer at a time."""
    ring.take_over()
    # The exit code matters more than the last event of the log.
    with suppress(RingFull):
        put_last_event(ring, event)
