"""The loop's end of the ring: rows, and signs of life."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TypeVar

from pamctl.recording.ring import LoopStage, RecorderFlag, Ring, RingFull
from pamctl.signals import TickRecord

Put = TypeVar("Put")


class RingJournal:
    """Puts rows, and writes the loop's heartbeat and worst lateness into the ring's header."""

    def __init__(self, ring: Ring, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """`now_ns` is the monotonic clock that others compare the heartbeat with."""
        self._ring = ring
        self._now_ns = now_ns
        self._worst_late_s = 0.0

    def put_tick(self, record: TickRecord) -> None:
        """Put a tick; raise `RingFull` if there is no room."""
        self._ring.put_tick(record)
        self._show_life(record.timing.late_s)

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        """Put a tick that is packed already; raise `RingFull` if there is no room."""
        self._ring.put_row(row)
        self._show_life(late_s)

    def _show_life(self, late_s: float) -> None:
        self._ring.loop_beat_ns = self._now_ns()
        if late_s > self._worst_late_s:
            self._worst_late_s = late_s
            self._ring.worst_late_ns = round(late_s * 1e9)

    def rehearse_tick(self, record: TickRecord) -> None:
        """Do what `put_tick` does, up to the point where others would see it."""
        self._ring.rehearse_tick(record)

    def rehearse_row(self, row: bytearray) -> None:
        """Do what `put_row` does, up to the point where others would see it."""
        self._ring.rehearse_row(row)

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Put an event. The first event, just before the first tick, starts the heartbeat."""
        self._ring.put_event(tick, t_ns, event)
        self._ring.loop_beat_ns = self._now_ns()
        self._ring.loop_stage = LoopStage.TICKING

    def put_gains(self, tick: int, t_ns: int, gains: Mapping[str, object]) -> None:
        """Put gains that apply from the next tick on."""
        self._ring.put_gains(tick, t_ns, gains)

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Put the frozen state."""
        self._ring.put_keyframe(tick, t_ns, state)

    def end_ticks(self) -> None:
        """Tell the guardian to wait longer: releasing a card takes longer than a tick."""
        self._ring.loop_beat_ns = self._now_ns()
        self._ring.loop_stage = LoopStage.LEAVING


class PatientJournal(RingJournal):
    """For runs without a clock: if the ring is full, it waits for the recorder."""

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        """Put a tick that is packed already, as soon as there is room."""
        self._put_patiently(lambda: self._ring.put_row(row))

    def put_rows(self, rows: memoryview) -> None:
        """Put ticks that are packed already, as there is room for them."""
        while rows:
            rows = self._put_patiently(partial(self._put_some, rows))
        self._ring.loop_beat_ns = self._now_ns()

    def _put_some(self, rows: memoryview) -> memoryview:
        others = self._ring.put_rows(rows)
        if len(others) == len(rows):
            raise RingFull("the ring is full: the recorder is behind or gone")
        return others

    def put_tick(self, record: TickRecord) -> None:
        """Put a tick as soon as there is room."""
        try:
            self._ring.put_tick(record)
        except RingFull:
            self._put_patiently(lambda: self._ring.put_tick(record))
        if not record.timing.tick % _BEAT_EVERY_TICKS:
            self._ring.loop_beat_ns = self._now_ns()

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Put an event as soon as there is room."""
        self._put_patiently(lambda: self._ring.put_event(tick, t_ns, event))

    def put_gains(self, tick: int, t_ns: int, gains: Mapping[str, object]) -> None:
        """Put gains as soon as there is room."""
        self._put_patiently(lambda: self._ring.put_gains(tick, t_ns, gains))

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Put the frozen state as soon as there is room."""
        self._put_patiently(lambda: self._ring.put_keyframe(tick, t_ns, state))

    def _put_patiently(self, put: Callable[[], Put]) -> Put:
        """Try until it succeeds; give up if the recorder has failed or fallen silent."""
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
"""A recorder without a sign of life for this time counts as dead."""
