"""When the tick runs: the section `loop` of a rig file, and the only source of time in the loop.

`GridClock` wakes on an absolute grid of CLOCK_MONOTONIC, so that the lateness of one tick never
delays the next one and the rate cannot drift. `SampleClock` is paced by hardware that samples on a
clock of its own. `VirtualClock` has no clock at all: it counts.

All times are whole nanoseconds in plain ints: exact, and free of the rounding of float seconds.
"""

from __future__ import annotations

import ctypes
import errno
import os
import time
from collections.abc import Callable, Mapping
from typing import Annotated, NamedTuple, Protocol

from pydantic import Field, model_validator

from hal.calibration import Configured
from hal.rig import Edge

PHASE_NS = 300_000
"""Where in the millisecond the grid lies. The kernel's own tick (250, 300 or 1000 times a second)
falls on whole milliseconds of CLOCK_MONOTONIC; a deadline there waits for its work. 300 us later
that work is done, and the next is far away: the 99th percentile falls from 26 to 1.5 us."""

SPIN_NS = 100_000
"""How long before the deadline the sleep ends and the spin begins: about twice the wake-up latency
that 99 of 100 sleeps stay below. Only for a loop under SCHED_FIFO with a CPU to spare; under
SCHED_OTHER spinning eats the time slice that the deadline will need."""


class Wake(NamedTuple):
    """One tick of a clock: `0 <= now_ns - deadline_ns < period_ns`, always."""

    tick: int
    """Index on the grid, from 0; a gap in it is a run of missed ticks."""
    deadline_ns: int
    """The grid point of this tick: `deadline_ns` of tick 0, plus `tick` periods."""
    now_ns: int
    """When the wait ended."""
    missed: int
    """Grid points skipped since the previous wake; 0 on the first."""


class Clock(Protocol):
    """What paces the loop."""

    @property
    def period_ns(self) -> int:
        """Distance of two grid points."""

    def now_ns(self) -> int:
        """Time on the clock's own scale; only differences mean anything."""

    def wall_offset_ns(self) -> int:
        """Unix time minus `now_ns`: read once a run, so that NTP cannot reorder a log."""

    def wait(self, rehearse: Callable[[], None] | None = None) -> Wake:
        """Wait for the next grid point that still lies ahead, and say which one it was.

        A clock that spins calls `rehearse` within the spin, if there is time for it.
        """


class GridClock:
    """Absolute deadlines: sleep until shortly before each, then spin onto it.

    The grid is laid when `wait` is called for the first time. Grid points that pass unused,
    because the tick took too long or the kernel woke us too late, are skipped and counted. They are
    never made up for: ticks in a burst would give the differentiating filters a dt near 0.

    Signals do not bring a tick forward. Their Python handlers run at once, within the wait; the
    wait then goes on to its deadline, and the loop meets the handler's flag there, at most one
    period later and with a regular dt. A handler that raises ends the wait; the clock stays
    valid, and the next `wait` counts what was missed.

    A rehearsal runs at the begin of the spin. During a sleep the CPU's caches lose the tick's code
    and data; the rehearsal fetches them again while there is nothing else to do. It is left out
    where its usual duration would not end before the deadline.

    Args:
        period_ns: distance of two grid points, ns.
        phase_ns: distance of the grid from whole periods of CLOCK_MONOTONIC, `0 <= phase <
            period`; by default 300 us, or 0.3 periods where that is less.
        spin_ns: how long before the deadline to stop sleeping, `0 <= spin < period`; 0: never.
        now_ns: reads the clock.
        sleep_until: sleeps until a time on that clock, however often it is interrupted.

    Raises:
        ValueError: a period, phase or spin out of its bounds.
        OSError: this system has no clock_nanosleep (only Linux runs the loop).
    """

    def __init__(
        self,
        period_ns: int,
        phase_ns: int | None = None,
        spin_ns: int = SPIN_NS,
        *,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep_until: Callable[[int], None] | None = None,
    ) -> None:
        """Check the arguments; the class describes them."""
        if period_ns <= 0:
            raise ValueError(f"period_ns must be positive, got {period_ns}")
        if phase_ns is None:
            phase_ns = min(PHASE_NS, 3 * period_ns // 10)
        _require_within_period("phase_ns", phase_ns, period_ns)
        _require_within_period("spin_ns", spin_ns, period_ns)
        self.period_ns = period_ns
        self._phase_ns = phase_ns
        self._spin_ns = spin_ns
        self._rehearsal_ns = spin_ns // 2
        self.now_ns = now_ns
        self._sleep_until = sleep_until or make_monotonic_sleeper()
        self._tick = -1
        self._deadline_ns = 0

    def wall_offset_ns(self) -> int:
        """Unix time minus CLOCK_MONOTONIC, good to a microsecond or so."""
        before_ns = self.now_ns()
        wall_ns = time.time_ns()
        return wall_ns - (before_ns + self.now_ns()) // 2

    def wait(self, rehearse: Callable[[], None] | None = None) -> Wake:
        """Wait for the next grid point that still lies ahead."""
        if self._tick < 0:
            return self._wait_first()
        period_ns = self.period_ns
        previous_ns = self._deadline_ns
        deadline_ns = previous_ns + period_ns
        now_ns = self.now_ns()
        if now_ns > deadline_ns:  # the tick took too long
            deadline_ns = grid_point_from(now_ns, deadline_ns, period_ns)
        now_ns = self._reach(deadline_ns, now_ns, rehearse)
        if now_ns >= deadline_ns + period_ns:  # the sleep did
            deadline_ns = grid_point_until(now_ns, deadline_ns, period_ns)
        advanced = (deadline_ns - previous_ns) // period_ns
        # Only now, so that an exception out of the wait leaves the previous tick standing.
        self._tick += advanced
        self._deadline_ns = deadline_ns
        return Wake(self._tick, deadline_ns, now_ns, advanced - 1)

    def _wait_first(self) -> Wake:
        before_ns = self.now_ns()
        deadline_ns = (before_ns // self.period_ns + 1) * self.period_ns + self._phase_ns
        now_ns = self._reach(deadline_ns, before_ns)
        # However late this wake is, there was no tick before it: nothing was missed.
        self._deadline_ns = grid_point_until(now_ns, deadline_ns, self.period_ns)
        self._tick = 0
        return Wake(0, self._deadline_ns, now_ns, 0)

    def _reach(
        self, deadline_ns: int, now_ns: int, rehearse: Callable[[], None] | None = None
    ) -> int:
        """Sleep, rehearse and spin until the deadline has come; the time it then is."""
        alarm_ns = deadline_ns - self._spin_ns
        if now_ns < alarm_ns:
            self._sleep_until(alarm_ns)
        read_ns = self.now_ns
        now_ns = read_ns()
        if rehearse is not None:
            self._rehearse(rehearse, now_ns, deadline_ns)
            now_ns = read_ns()
        while now_ns < deadline_ns:
            now_ns = read_ns()
        return now_ns

    def _rehearse(self, rehearse: Callable[[], None], now_ns: int, deadline_ns: int) -> None:
        """Rehearse if the longest of the last rehearsals would end before the deadline.

        One that was interrupted looks long. It is forgotten within some tens of ticks.
        """
        expected_ns = self._rehearsal_ns
        if now_ns + expected_ns < deadline_ns:
            rehearse()
            took_ns = self.now_ns() - now_ns
            if took_ns > expected_ns:
                self._rehearsal_ns = took_ns + (took_ns >> 3)
                return
        self._rehearsal_ns = expected_ns - (expected_ns >> 6)


class SampleClock:
    """The rig is the clock: a tick begins when the hardware has taken a sample.

    The grid is the hardware's, as far as it can be seen from here: `deadline_ns` is when the
    sample was taken. It may be moved by a few microseconds when a wait is more prompt than all
    before it.

    Args:
        host: tells the time between the ticks, and the nominal period.
        await_edge: waits for the next sample, and says when it was taken; what it raises goes
            through `wait`.
    """

    def __init__(self, host: Clock, await_edge: Callable[[], Edge]) -> None:
        """Check the arguments; the class describes them."""
        self.period_ns = host.period_ns
        self.now_ns = host.now_ns
        self.wall_offset_ns = host.wall_offset_ns
        self._await_edge = await_edge
        self._tick = -1

    def wait(self, rehearse: Callable[[], None] | None = None) -> Wake:
        """Wait for the next sample; whatever passed before the first one was not missed."""
        edge = self._await_edge()
        missed = edge.elapsed - 1 if self._tick >= 0 else 0
        self._tick += 1 + missed
        return Wake(self._tick, edge.t_ns, edge.now_ns, missed)


class VirtualClock:
    """No clock at all: every wait returns at once, one period later.

    Args:
        period_ns: distance of two ticks, ns.
        missed: what a test wants missed: `{5: 3}` makes the tick due as 5 come as 8.
    """

    def __init__(self, period_ns: int, missed: Mapping[int, int] | None = None) -> None:
        """Check the arguments; the class describes them."""
        if period_ns <= 0:
            raise ValueError(f"period_ns must be positive, got {period_ns}")
        self.period_ns = period_ns
        self._missed = dict(missed or {})
        self._tick = -1
        self._now_ns = 0

    def now_ns(self) -> int:
        """Time of the current tick: stands still until the next `wait`; 0 before the first."""
        return self._now_ns

    def wall_offset_ns(self) -> int:
        """Nothing, so that the same seed gives the same bytes on every day."""
        return 0

    def wait(self, rehearse: Callable[[], None] | None = None) -> Wake:
        """Go on to the next tick."""
        due = self._tick + 1
        missed = self._missed.get(due, 0)
        self._tick = due + missed
        now_ns = self._now_ns = self._tick * self.period_ns
        return Wake(self._tick, now_ns, now_ns, missed)

    def skip_to(self, tick: int) -> None:
        """Take note that all ticks up to this one are done."""
        self._tick = tick
        self._now_ns = tick * self.period_ns


class SleepWatch:
    """Tells how long the PC has slept: CLOCK_BOOTTIME counts that time, CLOCK_MONOTONIC does not.

    To a loop on CLOCK_MONOTONIC a PC that has slept looks as if nothing had been.
    """

    def __init__(self) -> None:
        """Begin to watch."""
        self._ahead_ns = max(_boot_ahead_ns() for _ in range(5))

    def slept_ns(self) -> int:
        """Return for how long the PC has slept since the watch began."""
        return max(0, _boot_ahead_ns() - self._ahead_ns)


def _boot_ahead_ns() -> int:
    # In this order: a pause between the two makes the result less, and never more.
    boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return boot_ns - time.monotonic_ns()


def grid_point_from(time_ns: int, point_ns: int, period_ns: int) -> int:
    """The first point at or after `time_ns` of the grid that has a point at `point_ns`."""
    return point_ns + -((point_ns - time_ns) // period_ns) * period_ns


def grid_point_until(time_ns: int, point_ns: int, period_ns: int) -> int:
    """The last point at or before `time_ns` of the grid that has a point at `point_ns`."""
    return point_ns + (time_ns - point_ns) // period_ns * period_ns


def make_monotonic_sleeper() -> Callable[[int], None]:
    """A function that sleeps until an absolute time of CLOCK_MONOTONIC, in ns.

    `time.sleep` would do nearly as well, but takes a duration: what happens between reading the
    clock and falling asleep (a preemption, a signal) would be added to it.

    Raises:
        OSError: this system has no clock_nanosleep.
    """
    clock_nanosleep = _load_clock_nanosleep()
    until = _Timespec()  # kept, and filled in place: nothing is allocated in a tick
    until_pointer = ctypes.pointer(until)
    timer_abstime = 1
    clock_monotonic = time.CLOCK_MONOTONIC

    def sleep_until(time_ns: int) -> None:
        until.tv_sec, until.tv_nsec = divmod(time_ns, 1_000_000_000)
        status = clock_nanosleep(clock_monotonic, timer_abstime, until_pointer, None)
        # Python runs the handler of the signal where the loop turns back, then we sleep on. The
        # time is absolute, so any number of signals leaves the deadline where it is.
        while status:
            if status != errno.EINTR:
                raise OSError(status, f"clock_nanosleep: {os.strerror(status)}")
            status = clock_nanosleep(clock_monotonic, timer_abstime, until_pointer, None)

    return sleep_until


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


def _load_clock_nanosleep() -> Callable[..., int]:
    try:
        function = ctypes.CDLL(None).clock_nanosleep
    except (AttributeError, TypeError, OSError):
        raise OSError("no clock_nanosleep on this system: the real-time loop needs Linux") from None
    function.argtypes = (
        ctypes.c_int,
        ctypes.c_int,
        ctypes.POINTER(_Timespec),
        ctypes.POINTER(_Timespec),
    )
    function.restype = ctypes.c_int
    return function


def _require_within_period(name: str, value_ns: int, period_ns: int) -> None:
    if not 0 <= value_ns < period_ns:
        raise ValueError(f"{name} must be >= 0 and below the period ({period_ns}), got {value_ns}")


class LoopSettings(Configured):
    """How the loop is paced, and how it stops."""

    rate_hz: Annotated[
        float,
        Field(
            ge=100,
            le=10_000,
            description="ticks a second; a run warns where this PC cannot hold the rate",
        ),
    ] = 1000.0
    spin_us: Annotated[
        float, Field(ge=0, le=500, description="busy wait before each deadline, under FIFO only")
    ] = 100.0
    cpu: Annotated[int | None, Field(ge=0, description="CPU of the loop; the last if absent")] = (
        None
    )
    heartbeat_ms: Annotated[
        float,
        Field(ge=20, le=10_000, description="a loop silent for longer is killed by the guardian"),
    ] = 50.0
    starved_ms: Annotated[
        float,
        Field(
            ge=0,
            le=60_000,
            description="a silent loop that gets no CPU is killed after this time, "
            "or after heartbeat_ms if that is longer",
        ),
    ] = 0.0
    stop_ramp_s: Annotated[
        float, Field(ge=0.001, le=5, description="from the last command to the safe one")
    ] = 0.5
    ring_rows: Annotated[
        int, Field(ge=256, le=1_000_000, description="ticks that fit between loop and recorder")
    ] = 16_384

    @model_validator(mode="after")
    def _check_period(self) -> LoopSettings:
        if self.spin_us * self.rate_hz > 0.5e6:
            raise ValueError(
                f"spin_us {self.spin_us:g} is more than half of the period of "
                f"{1e6 / self.rate_hz:g} us at rate_hz {self.rate_hz:g}"
            )
        if self.heartbeat_ms * self.rate_hz < 3e3:
            raise ValueError(
                f"heartbeat_ms {self.heartbeat_ms:g} is less than three periods of "
                f"{1e3 / self.rate_hz:g} ms at rate_hz {self.rate_hz:g}"
            )
        if self.ring_rows < 2 * self.stop_rows:
            raise ValueError(
                f"ring_rows {self.ring_rows} is too few: the {self.stop_rows} ticks of a stop of "
                f"{self.stop_ramp_s:g} s at rate_hz {self.rate_hz:g} may fill half of them"
            )
        return self

    @property
    def stop_rows(self) -> int:
        """Rows that the ticks and events of a smooth stop need, and a little more."""
        return round(self.rate_hz * (self.stop_ramp_s + 0.1)) + 16
