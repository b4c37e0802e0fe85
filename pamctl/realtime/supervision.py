"""What ends a run from outside: a signal, the death of front or guardian, a recorder in trouble."""

from __future__ import annotations

import select
import signal
import time
from types import FrameType

from pamctl.realtime.ending import Ending, ExitCode
from pamctl.realtime.journal import SILENT_RECORDER_S
from pamctl.realtime.pace import LoopSettings
from pamctl.realtime.ring import RecorderFlag, Ring

STOP_SIGNALS = {signal.SIGINT: ExitCode.SIGINT, signal.SIGTERM: ExitCode.SIGTERM}
_LOOK_EVERY_S = 8e-3


class LoopSupervisor:
    """Asked once a tick; costs a fraction of a microsecond in most of them."""

    def __init__(
        self, ring: Ring, front_fd: int | None, pace: LoopSettings, *, patient: bool = False
    ) -> None:
        """`front_fd` is a pipe whose other end the front holds; its end is the front's.

        A `patient` run waits for a slow recorder instead of giving up on it.
        """
        self._ring = ring
        self._asked = 0
        # Counted in questions: a tick's number may be among the missed ones.
        self._look_every = max(1, round(pace.rate_hz * _LOOK_EVERY_S))
        # Room for the ticks of a smooth stop must be left when the ring is called too full.
        self._fullest = ring.rows - pace.stop_rows
        self._patient = patient
        self._signals: list[int] = []
        self._beats = -1
        self._beat_s = time.monotonic()
        self._front = select.poll()
        if front_fd is not None:
            self._front.register(front_fd, select.POLLHUP | select.POLLERR)

    def listen(self) -> None:
        """Take over SIGINT and SIGTERM: the first stops smoothly, the second at once."""
        for number in STOP_SIGNALS:
            signal.signal(number, self._on_signal)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._signals.append(number)

    def abort_wanted(self) -> bool:
        """Tell whether a second signal came."""
        return len(self._signals) > 1

    def stop_wanted(self, tick: int) -> Ending | None:
        """Return why and how to stop, once there is a reason to."""
        if self._signals:
            number = signal.Signals(self._signals[0])
            return Ending(STOP_SIGNALS[number], f"stopped by {number.name}")
        self._asked += 1
        if self._asked % self._look_every:
            return None
        return self._trouble()

    def _trouble(self) -> Ending | None:
        """Look around: every few milliseconds is often enough."""
        flags = self._ring.recorder_flags
        if flags & RecorderFlag.DISK_FULL:
            return Ending(ExitCode.UNEXPECTED, "the log's disk is full")
        if flags & RecorderFlag.FAILED:
            return Ending(ExitCode.UNEXPECTED, "the recorder failed")
        if self._ring.guardian_lost:
            return Ending(ExitCode.UNEXPECTED, "the guardian is gone")
        if self._front.poll(0):
            return Ending(ExitCode.UNEXPECTED, "the commanding process is gone")
        return None if self._patient else self._recorder_trouble()

    def _recorder_trouble(self) -> Ending | None:
        ring = self._ring
        if ring.pending > self._fullest:
            return Ending(ExitCode.UNEXPECTED, "the recorder is too far behind")
        if ring.recorder_beats != self._beats:
            self._beats, self._beat_s = ring.recorder_beats, time.monotonic()
        elif time.monotonic() - self._beat_s > SILENT_RECORDER_S:
            return Ending(ExitCode.UNEXPECTED, "the recorder gives no sign of life")
        return None
