"""What ends a run from outside: a signal, the death of another process, a recorder in trouble.

A signal, a full disk and a slow recorder leave time for a smooth stop. The death of a process
does not: the loop may be killed next, and a smooth stop that is cut short leaves the valve open.
Nor does a PC that has slept: nobody knows what muscle and card did meanwhile.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from types import FrameType

from hal.child import ParentPipe
from pamctl.base.errors import EMERGENCY_STOP, LOG_DISK_FULL, Ending, ExitCode
from pamctl.processes.interrupts import STOP_SIGNALS
from pamctl.realtime.clock import LoopSettings, SleepWatch
from pamctl.realtime.orders import Orders
from pamctl.recording.journal import SILENT_RECORDER_S, StandStill
from pamctl.recording.ring import RecorderFlag, Ring

_LOOK_EVERY_S = 8e-3
_SLEPT = "safety trip: the PC slept"
_FRONT_GONE = "the commanding process is gone"
STARTS_WITHIN_S = 60.0
"""Time for the processes of a run to find each other (s). A disk that is busy with other work may
hold an import for ten seconds; meanwhile the rig is not open, and a signal still ends the wait."""


class LoopSupervisor:
    """Asked once a tick; in most ticks it costs a fraction of a microsecond."""

    def __init__(
        self,
        ring: Ring,
        front_fd: int | None,
        pace: LoopSettings,
        *,
        patient: bool = False,
        orders: Orders | None = None,
    ) -> None:
        """`front_fd` is a pipe that the front holds open: the pipe's end is the front's death.

        A `patient` run has no clock, no front and no guardian, and waits for a slow recorder
        instead of giving up on it. An emergency stop comes through `orders`.
        """
        self._orders = orders
        self._ring = ring
        self._asked = 0
        # Counted in calls, not in tick numbers, because ticks may be missed.
        self._look_every = max(1, round(pace.rate_hz * _LOOK_EVERY_S))
        # When the ring counts as too full, it must still have room for a smooth stop.
        self._spare_rows = pace.stop_rows
        self._patient = patient
        # Counted in looks, not in time: a machine that stood still says nothing of the guardian.
        silent_looks = math.ceil(pace.heartbeat_ms * 1e-3 * pace.rate_hz / self._look_every)
        self._guardian = _Heartbeat(max(2, silent_looks))
        self._is_time_to_look = False
        # A sleep is a silence too, on a clock that the loop does not see.
        self._sleep = None if patient else SleepWatch()
        self._longest_sleep_ns = round(pace.heartbeat_ms * 1e6)
        self._loss: Ending | None = None
        self._signals: list[int] = []
        self.watch_recording(ring)
        self._front = None if front_fd is None else ParentPipe(front_fd)

    def watch_recording(self, ring: Ring | None) -> None:
        """Watch the recorder of this ring from now on; None: nothing is recorded."""
        self._recorded: Ring | None = ring
        self._silence = StandStill(lambda: ring.recorder_beats if ring else 0)

    def listen(self) -> None:
        """Take over the signals that end a run: the first stops smoothly, the second at once."""
        for number in STOP_SIGNALS:
            # Ignored under nohup. A front passes on what its loop shall obey, whatever it inherits.
            if self._front is not None or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)
        if self._front is not None:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._signals.append(number)

    def await_start(
        self, who: str, is_ready: Callable[[], bool], is_lost: Callable[[], bool]
    ) -> Ending | None:
        """Wait for another process, before the rig is open; return why it is in vain."""
        deadline_s = time.monotonic() + STARTS_WITHIN_S
        while not is_ready():
            if (asked := self.find_stop(0)) is not None:
                return asked
            if self.is_front_gone():
                return Ending(ExitCode.UNEXPECTED, _FRONT_GONE)
            if is_lost() or time.monotonic() > deadline_s:
                return Ending(ExitCode.UNEXPECTED, f"the {who} did not start")
            time.sleep(2e-3)
        return None

    def wants_abort(self) -> bool:
        """Say whether to stop at once: a second signal, the death of a process, a PC that slept.

        So does an emergency stop.
        Call it first in every tick, also during a smooth stop.
        """
        self._asked += 1
        # Every few milliseconds is often enough.
        self._is_time_to_look = not self._asked % self._look_every
        if self._is_time_to_look and self._loss is None:
            lost = self._name_lost_process()
            loss = Ending(ExitCode.UNEXPECTED, lost) if lost else None
            self._loss = self._find_sleep() or loss
        return self._loss is not None or len(self._signals) > 1 or self._is_emergency

    def find_stop(self, tick: int) -> Ending | None:
        """Return why and how to stop, once there is a reason to."""
        if self._is_emergency:
            return Ending(ExitCode.SAFETY_TRIP, EMERGENCY_STOP)
        if self._signals:
            number = signal.Signals(self._signals[0])
            return Ending(STOP_SIGNALS[number], f"stopped by {number.name}")
        if self._loss is not None:
            return self._loss
        return self._find_recorder_trouble() if self._is_time_to_look else None

    @property
    def _is_emergency(self) -> bool:
        return self._orders is not None and self._orders.emergency

    def name_cause(self, ending: Ending) -> Ending:
        """Return how a run ended: a PC that slept is the cause of whatever failed after it."""
        slept = self._find_sleep()
        if slept is None or not ending.code or ending.reason.startswith(_SLEPT):
            return ending
        return slept._replace(reason=f"{slept.reason}; {ending.reason}")

    def is_front_gone(self) -> bool:
        """Tell whether the process that started this one is dead."""
        return self._front is not None and self._front.wait()

    def may_be_last(self) -> bool:
        """Tell whether another process is gone: the rest may die before the log is finished."""
        return self._loss is not None or self.is_front_gone()

    def _find_sleep(self) -> Ending | None:
        if self._sleep is None or (slept_ns := self._sleep.slept_ns()) <= self._longest_sleep_ns:
            return None
        slept_s = slept_ns * 1e-9
        return Ending(ExitCode.SAFETY_TRIP, f"{_SLEPT} for {slept_s:.1f} s during the run")

    def _name_lost_process(self) -> str:
        """Return which of the other processes is gone; nothing where all are alive."""
        ring, recorded = self._ring, self._recorded
        flags = recorded.recorder_flags if recorded else 0
        if flags & RecorderFlag.FAILED and not flags & RecorderFlag.DISK_FULL:
            return "the recorder failed"
        if ring.guardian_lost:
            return "the guardian is gone"
        if not self._patient and self._guardian.is_lost(ring.guardian_beats):
            return "the guardian gives no sign of life"
        if self.is_front_gone():
            return _FRONT_GONE
        return ""

    def _find_recorder_trouble(self) -> Ending | None:
        ring = self._recorded
        if ring is None:
            return None
        if ring.recorder_flags & RecorderFlag.DISK_FULL:
            return Ending(ExitCode.UNEXPECTED, LOG_DISK_FULL)
        if self._patient:
            return None
        if ring.pending > ring.rows - self._spare_rows:
            return Ending(ExitCode.UNEXPECTED, "the recorder is too far behind")
        if self._silence.lasts_s() > SILENT_RECORDER_S:
            return Ending(ExitCode.UNEXPECTED, "the recorder gives no sign of life")
        return None


class _Heartbeat:
    """A heartbeat that is looked at in intervals."""

    def __init__(self, most_looks: int) -> None:
        """After `most_looks` looks in a row without a beat it counts as lost."""
        self._most = most_looks
        self._beats = -1
        self._still = 0

    def is_lost(self, beats: int) -> bool:
        """Look once more."""
        self._still = 0 if beats != self._beats else self._still + 1
        self._beats = beats
        return self._still >= self._most
