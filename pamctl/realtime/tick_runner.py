"""Runs the ticks of a loop one after the other, and keeps the results of the last one.

Each tick is a call of `run_ticks` with n = 1: machine code where there is a compiler, else plain
Python, with the same bits. What a tick costs is measured before the rig is open, for the loop's
rate.
"""

from __future__ import annotations

import math
import struct
import time
from array import array
from collections.abc import Callable, Sequence
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.control.course import NO_COURSE, Course, CoursePlace, make_valve_reference
from pamctl.kernel.calls import Call, PlainCall, prepare
from pamctl.realtime.clock import Wake
from pamctl.realtime.run_ticks import (
    NOWHERE,
    Guide,
    LoopState,
    Nothing,
    OpenRig,
    Sensed,
    make_timing,
    run_ticks,
    start_loop,
)
from pamctl.realtime.tick import TickSetup, TickState, first_state, freeze_state
from pamctl.recording.rows import ROW_BYTES, ROW_HEADER, make_rows, tick_struct
from pamctl.signals import (
    TICK_FIELDS,
    Decision,
    Phase,
    Reference,
    TickOutcome,
    Timing,
    Truth,
)

if TYPE_CHECKING:
    from pamctl.recording.journal import RingJournal

RunningCourse = tuple[Course, float]
"""A course, and when it began (s), while only the time decides the reference."""
AskAgain = Callable[[float], Reference | None]
"""Gives the reference of a time (s) once more; None if that would change something."""
UPDATES = ("loop", "inner", "outer", "n")
"""The arguments of `run_ticks` that get its results."""

_KNOWN_LATER = ("outcome", "truth")
_OUTCOME_AT = (
    ROW_HEADER.size + tick_struct([f for f in TICK_FIELDS if f.stage not in _KNOWN_LATER]).size
)
"""Where in a row the outcome begins, with the truth after it."""
_PUT_OUTCOME = struct.Struct("6d").pack_into
_NO_OUTCOME = TickOutcome(math.nan, 0.0, 0.0, 0.0)
_UNKNOWN = Truth(math.nan, math.nan)
_NO_TABLE = array("d", (0.0,))


class TickRunner:
    """The tick of a loop."""

    def __init__(self, setup: TickSetup, prepare: Callable[..., Call] = prepare) -> None:
        """Run ticks with such a set-up; `prepare` makes the call, by default as machine code.

        Raise `NotInC` for a law that is no kernel.
        """
        self.setup = setup
        """The set-up of the last tick, or of the next one."""
        self._course: Course | None = None
        self.guide = Guide(NOWHERE, _NO_TABLE, False)
        """Where the references come from."""
        self._wake = Wake(0, 0, 0, 0)
        self.follows = False
        """The next tick follows a course that the kernel has."""
        self._use_call(prepare)

    def _use_call(self, prepare: Callable[..., Call], loop: LoopState | None = None) -> None:
        """Make the call of `run_ticks`, and what reads its results."""
        setup = self.setup
        self._rows = make_rows(setup.compensation is not None, 1)
        self._double: Call | None = None
        arguments = {
            "setup": setup,
            "loop": loop or start_loop(first_state(setup, Zero(0.0, 0.0)), 0, 0),
            "rig": OpenRig(),
            "inner": Sensed(self._wake, RawSample(0.0, 0, 0, 0)),
            "outer": Nothing(),
            "guide": self.guide,
            "rows": self._rows,
            "n": 1,
        }
        call = self.call = prepare(run_ticks, arguments, UPDATES)
        self._ticks_done = call.reader("n", "")
        self._get_output_v = call.reader("loop", "output_v")
        self._get_first_t_ns = call.reader("loop", "first_t_ns")
        self._get_raw = call.reader("loop", "raw")
        self._get_timing = call.reader("loop", "timing")
        self._get_decision = call.reader("loop", "decision")

    @property
    def way(self) -> str:
        """How the tick is run, in words for the log."""
        return "machine code" if self.call.is_native else "plain Python"

    # --- the last tick -----------------------------------------------------------------

    @property
    def loop(self) -> LoopState:
        """All that the last tick has left."""
        loop: LoopState = self.call.get("loop")
        return loop

    @property
    def raw(self) -> RawSample:
        """The sample of the last tick."""
        raw: RawSample = self._get_raw()
        return raw

    @property
    def timing(self) -> Timing:
        """The time of the last tick."""
        timing: Timing = self._get_timing()
        return timing

    @property
    def reference(self) -> Reference:
        """The reference of the last tick."""
        return self.loop.reference

    @property
    def decision(self) -> Decision:
        """The decision of the last tick."""
        decision: Decision = self._get_decision()
        return decision

    @property
    def state(self) -> TickState:
        """The state after the last tick."""
        return self.loop.state

    @property
    def frozen(self) -> Sequence[float]:
        """The numbers of the state, as `freeze_state` gives them."""
        return freeze_state(self.state)

    @property
    def row(self) -> bytes:
        """The row of the last tick that was recorded."""
        return bytes(self._rows.buffer)

    @property
    def output_v(self) -> float:
        """The voltage that the last decision asks for."""
        volts: float = self._get_output_v()
        return volts

    # --- the next tick -----------------------------------------------------------------

    def begin(self, state: TickState, first_t_ns: int, last_t_ns: int) -> None:
        """Begin before the first tick; the tick before it would have been at `last_t_ns`."""
        self._course = None
        self.call.put("loop", start_loop(state, first_t_ns, last_t_ns))

    def restart(self, state: TickState) -> None:
        """Go on in time with another state."""
        self.call.put("loop", self.loop._replace(state=state))

    def take_over(self, loop: LoopState) -> None:
        """Go on after ticks that were run elsewhere."""
        self.call.put("loop", loop)

    def expect(self, setup: TickSetup | None, running: RunningCourse | None) -> None:
        """Take note of what the next tick may use; None where the loop must ask in that tick."""
        self.follows = False
        if setup is None or running is None or not self.call.fits("setup", setup):
            return
        course, begin_s = running
        if course is not self._course:
            if course.table is None:
                return
            self._take_course(
                course, CoursePlace(len(course.segments), 0, begin_s, course.duration_s)
            )
            self._put_guide(Guide(NOWHERE, course.table, False))
        self._use_setup(setup)
        self.follows = True

    def follow_course(self, wake: Wake, raw: RawSample) -> bool:
        """Run a tick on what was expected; False, and nothing done, where the loop must ask."""
        return self.follows and self._run(wake, raw)

    def time(self, wake: Wake, raw: RawSample) -> Timing:
        """Return the time of a tick that has not run yet."""
        return make_timing(self._get_first_t_ns(), self.raw.encoder_t_ns, wake, raw)

    def run(self, setup: TickSetup, wake: Wake, raw: RawSample, reference: Reference) -> None:
        """Run a tick. A set-up of other types, as of another law, is for plain Python from here."""
        self._use_setup(setup)
        if self._course is not None:
            self._take_course(None, NO_COURSE)
        self._put_guide(Guide(reference, _NO_TABLE, False))
        self._run(wake, raw)

    def _take_course(self, course: Course | None, place: CoursePlace) -> None:
        self._course = course
        self.call.put("loop", self.loop._replace(place=place))

    def _put_guide(self, guide: Guide) -> None:
        self.guide = guide
        self.call.put("guide", guide)

    def _use_setup(self, setup: TickSetup) -> None:
        if setup is self.setup:
            return
        self.setup = setup
        if self.call.fits("setup", setup):
            self.call.put("setup", setup)
        else:
            self._use_call(PlainCall, self.loop)

    def _run(self, wake: Wake, raw: RawSample) -> bool:
        self._wake = wake
        call = self.call
        call.put("inner", Sensed(wake, raw))
        call.run()
        if self._ticks_done():
            return True
        call.put("n", 1)  # the course is over
        return False

    # --- what becomes of it ------------------------------------------------------------

    def record(self, journal: RingJournal | _OneRow, outcome: TickOutcome, truth: Truth) -> None:
        """Put the last tick into the journal."""
        row, wake = self._rows.buffer, self._wake
        _PUT_OUTCOME(row, _OUTCOME_AT, *outcome, *truth)
        journal.put_row(row, (wake.now_ns - wake.deadline_ns) * 1e-9, wake.missed)

    def rehearse(self, ask: AskAgain, journal: RingJournal) -> None:
        """Run the last tick once more and forget it: the caches are warm for the next one."""
        double = self._double
        if double is None:
            rows = make_rows(self.setup.compensation is not None, 1)
            self._double_rows = rows
            double = self._double = self.call.double("rows", rows)
        double.take_over(self.call)
        if not self.follows:
            ask(self.timing.t_s)
        try:
            double.run()
        except (ArithmeticError, ValueError):  # a tick that fails says so when it is real
            return
        _PUT_OUTCOME(self._double_rows.buffer, _OUTCOME_AT, *_NO_OUTCOME, *_UNKNOWN)
        journal.rehearse_row(self._double_rows.buffer)


_REHEARSALS = 100
"""Some milliseconds in all."""

LIVE_FACTOR = 6.0
"""A tick after a sleep finds cold caches. Measured on two busy cores over the simulated rig: 7.5 us
rehearsed; live, with its reads and writes, 27 us (p50) to 43 us (p99) at 10 kHz."""

BUSY_SHARE = 0.5
"""Share of the period that ticks may take; the rest is for waking up late and for the slack."""


class TickCost(NamedTuple):
    """What one tick is estimated to take, and the highest rate that this allows."""

    rehearsed_s: float
    live_s: float
    held_hz: float

    @classmethod
    def estimate(cls, rehearsed_s: float, calls_s: float = 0.0) -> TickCost:
        """Estimate from a rehearsal; `calls_s` is what the calls of a real rig add."""
        live_s = LIVE_FACTOR * rehearsed_s + calls_s
        return cls(rehearsed_s, live_s, BUSY_SHARE / live_s)

    def find_warning(self, rate_hz: float) -> str:
        """Return one line if the loop cannot hold this rate; empty if it can."""
        if rate_hz <= self.held_hz:
            return ""
        return (
            f"rate_hz {rate_hz:g} leaves {1e6 / rate_hz:.0f} us for a tick that takes about "
            f"{self.live_s * 1e6:.0f} us on this PC: ticks will be missed. About "
            f"{self.held_hz:.0f} Hz can be held, less with a slow card: see `pamctl doctor`"
        )


def rehearse_tick_s(
    setup: TickSetup,
    period_s: float,
    now_ns: Callable[[], int] = time.perf_counter_ns,
    tick: TickRunner | None = None,
) -> float:
    """Return the median time of a tick without rig and clock: step, record, packing (s).

    `tick` runs it; it must begin afresh afterwards.
    """
    tick, journal = tick or TickRunner(setup), _OneRow()
    sensor_v = 0.5 * (setup.limits.sensor_low_v + setup.limits.sensor_high_v)
    period_ns = round(period_s * 1e9)
    tick.begin(first_state(setup, Zero(sensor_v, 0.0)), 0, -period_ns)
    references = (
        make_valve_reference(Phase.OPEN_LOOP, setup.limits.safe_valve_v),
        Reference(Phase.TRACK, 0.0, 0.0, 0.0, 0.0, math.nan),
    )
    outcome, truth = TickOutcome(0.0, 0.0, 0.0, 0.0), Truth(math.nan, math.nan)
    took_ns = []
    for at in range(_REHEARSALS):
        t_ns = at * period_ns
        raw, wake = RawSample(sensor_v, 0, t_ns, t_ns), Wake(at, t_ns, t_ns, 0)
        reference = references[at > 0]  # the law begins from rest
        began_ns = now_ns()
        tick.time(wake, raw)
        tick.run(setup, wake, raw, reference)
        tick.record(journal, outcome, truth)
        took_ns.append(now_ns() - began_ns)
    return median(took_ns) * 1e-9


class _OneRow:
    """Takes each tick as the ring does, into one row."""

    def __init__(self) -> None:
        self._row = bytearray(ROW_BYTES)

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        self._row[:] = row

    def rehearse_row(self, row: bytearray) -> None:
        self._row[:] = row
