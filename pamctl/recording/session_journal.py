"""The journal of a loop that outlives its runs: each run has a ring, and so a log, of its own.

Between runs ticks go into a ring that nobody reads. Heartbeat and worst lateness always
stand in that one, which the guardian watches as long as the loop lives.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

from pamctl.exit_codes import Ending
from pamctl.recording.last_words import make_outcome_event
from pamctl.recording.ring import LoopStage, Ring
from pamctl.signals import TickRecord

_FIRST_EVENTS = ("timing_setup", "rig", "zeroed")
"""What the log of every run begins with, as it was said last."""


class SessionJournal:
    """Puts rows into the ring of the run that goes on, or else into the session's own."""

    def __init__(self, session: Ring, recorded: Callable[[Ring | None], None]) -> None:
        """Begin between runs; `recorded` learns which ring has a recorder, or that none has."""
        self._session = session
        self._recorded = recorded
        self._ring = session
        self._standing: dict[str, Mapping[str, object]] = {}
        self._worst_late_s = 0.0

    @property
    def run(self) -> Ring | None:
        """The ring of the run that goes on; None between runs."""
        return None if self._ring is self._session else self._ring

    def begin_run(
        self,
        path: str,
        tick: int,
        t_ns: int,
        gains: Sequence[Mapping[str, object]],
        state: Sequence[float],
    ) -> None:
        """Turn to the fresh ring at `path`, and put first what a replay of its log starts from.

        That is the frozen state after `tick`, the last one that is not in this log.
        """
        ring = Ring.attach(path)
        for event in self._standing.values():
            ring.put_event(tick, t_ns, event)
        for said in gains:
            ring.put_gains(tick, t_ns, said)
        ring.put_keyframe(tick, t_ns, state)
        ring.loop_stage = LoopStage.TICKING
        self._ring, self._worst_late_s = ring, 0.0
        self._recorded(ring)

    def end_run(self, tick: int, t_ns: int, ending: Ending) -> None:
        """Say the run's last word, and turn to the session's own ring."""
        ring = self._ring
        if ring is self._session:
            return
        self._recorded(None)
        ring.put_event(tick, t_ns, make_outcome_event(ending))
        ring.loop_done = 1
        ring.close()
        self._ring = self._session

    def end_last_run(self, ending: Ending) -> None:
        """End a run that goes on, at its last tick: the session ends."""
        if self.run is not None:
            last = self.run.latest_tick() or {"tick": 0, "encoder_t_ns": 0}
            self.end_run(int(last["tick"]), int(last["encoder_t_ns"]), ending)

    def put_tick(self, record: TickRecord) -> None:
        """Keep a tick; raise `RingFull` if there is no room."""
        ring, session = self._ring, self._session
        ring.put_tick(record)
        now_ns = time.monotonic_ns()
        session.loop_beat_ns = now_ns
        if ring is session:
            session.commit(session.head)
        else:
            ring.loop_beat_ns = now_ns
        late_s = record.timing.late_s
        if late_s > self._worst_late_s:
            self._worst_late_s = late_s
            ring.worst_late_ns = round(late_s * 1e9)
        if record.timing.missed:
            ring.missed_ticks += record.timing.missed

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Keep an event. The first one, just before the first tick, starts the heartbeat."""
        if event["event"] in _FIRST_EVENTS:
            self._standing[str(event["event"])] = event
        self._ring.put_event(tick, t_ns, event)
        session = self._session
        session.commit(session.head)
        session.loop_beat_ns = time.monotonic_ns()
        session.loop_stage = LoopStage.TICKING

    def put_gains(self, tick: int, t_ns: int, gains: Mapping[str, object]) -> None:
        """Keep gains that hold from the next tick on."""
        self._ring.put_gains(tick, t_ns, gains)
        self._session.commit(self._session.head)

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Keep the frozen state, of a run."""
        if self._ring is not self._session:
            self._ring.put_keyframe(tick, t_ns, state)

    def end_ticks(self) -> None:
        """Ask the guardian for patience: to release a card takes longer than a tick."""
        self._session.loop_beat_ns = time.monotonic_ns()
        self._session.loop_stage = LoopStage.LEAVING
