"""The loop's end of the ring: rows, and signs of life."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

from pamctl.recording.ring import LoopStage, RecorderFlag, Ring

SILENT_RECORDER_S = 3.0
"""A recorder without a sign of life for this time counts as dead."""


class RingJournal:
    """Puts rows, and writes the loop's heartbeat and worst lateness into the ring's header.

    What puts a row raises `RingFull` if there is no room.
    """

    def __init__(self, ring: Ring, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """`now_ns` is the monotonic clock that others compare the heartbeat with."""
        self._ring = ring
        self._watched = ring
        """The ring whose heartbeat the guardian watches."""
        self._now_ns = now_ns
        self._worst_late_s = 0.0

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        """Put a tick that is packed already."""
        self._ring.put_row(row)
        self._show_life(late_s, missed)

    def put_rows(self, rows: memoryview) -> None:
        """Put many ticks that are packed already."""
        self._ring.put_rows(rows)
        self._watched.loop_beat_ns = self._now_ns()

    def _show_life(self, late_s: float, missed: int) -> None:
        self._watched.loop_beat_ns = self._now_ns()
        if late_s > self._worst_late_s:
            self._worst_late_s = late_s
            self._ring.worst_late_ns = round(late_s * 1e9)

    def rehearse_row(self, row: bytearray) -> None:
        """Do what `put_row` does, up to the point where others would see it."""
        self._ring.rehearse_row(row)

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Put an event. The first event, just before the first tick, starts the heartbeat."""
        self._ring.put_event(tick, t_ns, event)
        self._watched.loop_beat_ns = self._now_ns()
        self._watched.loop_stage = LoopStage.TICKING

    def put_gains(self, tick: int, t_ns: int, gains: Mapping[str, object]) -> None:
        """Put gains that apply from the next tick on."""
        self._ring.put_gains(tick, t_ns, gains)

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Put the frozen state."""
        self._ring.put_keyframe(tick, t_ns, state)

    def end_ticks(self) -> None:
        """Tell the guardian to wait longer: releasing a card takes longer than a tick."""
        self._watched.loop_beat_ns = self._now_ns()
        self._watched.loop_stage = LoopStage.LEAVING


def wait_for_recorder(ring: Ring) -> None:
    """Let a full ring wait for its recorder, in a run without a clock.

    It gives up if the recorder has failed or fallen silent.
    """

    def await_room(has_room: Callable[[], bool]) -> None:
        beats, since_s = ring.recorder_beats, time.monotonic()
        while not (has_room() or ring.recorder_flags & RecorderFlag.FAILED):
            if ring.recorder_beats != beats:
                beats, since_s = ring.recorder_beats, time.monotonic()
            elif time.monotonic() - since_s > SILENT_RECORDER_S:
                return
            time.sleep(1e-3)
            ring.loop_beat_ns = time.monotonic_ns()

    ring.await_room = await_room
