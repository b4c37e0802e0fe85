"""The loop's end of the ring: rows, and signs of life."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

from pamctl.recording.ring import LoopStage, RecorderFlag, Ring, RingFull
from pamctl.signals import TickRecord


class RingJournal:
    """Puts rows, and leaves the loop's heartbeat and worst lateness in the ring's header."""

    def __init__(self, ring: Ring, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """`now_ns` is the monotonic clock that others compare the heartbeat with."""
        self._ring = ring
        self._now_ns = now_ns
        self._worst_late_s = 0.0

    def put_tick(self, record: TickRecord) -> None:
        """Keep a tick; raise `RingFull` if there is no room."""
        self._ring.put_tick(record)
        self._ring.loop_beat_ns = self._now_ns()
        late_s = record.timing.late_s
        if late_s > self._worst_late_s:
            self._worst_late_s = late_s
            self._ring.worst_late_ns = round(late_s * 1e9)

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Keep an event. The first one, just before the first tick, starts the heartbeat."""
        self._ring.put_event(tick, t_ns, event)
        self._ring.loop_beat_ns = self._now_ns()
        self._ring.loop_stage = LoopStage.TICKING

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Keep the frozen state."""
        self._ring.put_keyframe(tick, t_ns, state)

    def end_ticks(self) -> None:
        """Ask the guardian for patience: to release a card takes longer than a tick."""
        self._ring.loop_beat_ns = self._now_ns()
        self._ring.loop_stage = LoopStage.LEAVING


class PatientJournal(RingJournal):
    """Without a clock nobody is in a hurry: a full ring waits for its recorder."""

    def put_tick(self, record: TickRecord) -> None:
        """Keep a tick, whenever there is room."""
        try:
            self._ring.put_tick(record)
        except RingFull:
            self._put_patiently(lambda: self._ring.put_tick(record))
        if not record.timing.tick % _BEAT_EVERY_TICKS:
            self._ring.loop_beat_ns = self._now_ns()

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Keep an event, whenever there is room."""
        self._put_patiently(lambda: self._ring.put_event(tick, t_ns, event))

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Keep the frozen state, whenever there is room."""
        self._put_patiently(lambda: self._ring.put_keyframe(tick, t_ns, state))

    def _put_patiently(self, put: Callable[[], None]) -> None:
        """Try until it succeeds; give up on a recorder that has failed or fallen silent."""
        beats, silent_since_s = self._ring.recorder_beats, time.monotonic()
        while True:
            try:
                return put()
            except RingFull:
                if self._ring.recorder_flags & RecorderFlag.FAILED:
                    raise
                if self._ring.recorder_beats != beats:
                    beats, silent_since_s = self._ring.recorder_beats, time.monotonic()
                if time.monotonic() - silent_since_s > SILENT_RECORDER_S:
                    raise
                time.sleep(1e-3)
                self._ring.loop_beat_ns = self._now_ns()


_BEAT_EVERY_TICKS = 256

SILENT_RECORDER_S = 3.0
"""A recorder without a sign of life for so long is taken for dead."""
