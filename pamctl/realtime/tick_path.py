"""Two ways to run a tick, with the same bits: plain Python, and machine code built ahead.

The loop holds one of them; it keeps the results of the last tick. Plain Python is the reference.
Where machine code reports an error, plain Python runs that tick and says what is wrong.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Protocol

from hal.calibration import Zero, output_v
from hal.rig import RawSample
from pamctl.compiled_ahead.layout import WORD_BYTES
from pamctl.compiled_ahead.library import KernelLibrary
from pamctl.control.course import Course
from pamctl.control.course_table import NO_COURSE, CoursePlace
from pamctl.realtime.clock import Wake
from pamctl.realtime.keyframe import freeze_state
from pamctl.realtime.tick import TickSetup, TickState, first_state, step
from pamctl.realtime.tick_words import (
    OUTCOME_AT,
    TABLE_BYTES,
    Answered,
    Sensed,
    TickWords,
)
from pamctl.realtime.whole_tick import TickTimes, make_timing
from pamctl.recording.ring import ROW_BYTES, ROW_HEADER, RowKind, tick_struct
from pamctl.signals import Decision, Reference, TickOutcome, TickRecord, Timing, Truth

RunningCourse = tuple[Course, float]
"""A course, and when it began (s), while only the time decides the reference."""


AskAgain = Callable[[float], Reference | None]
"""Gives the reference of a time (s) once more; None if that would change something."""


class TickJournal(Protocol):
    """Takes the ticks."""

    def put_tick(self, record: TickRecord) -> None:
        """Keep a tick."""

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        """Keep a tick that is packed already as a row of the ring."""

    def rehearse_tick(self, record: TickRecord) -> None:
        """Do the work of `put_tick`, and keep nothing."""

    def rehearse_row(self, row: bytearray) -> None:
        """Do the work of `put_row`, and keep nothing."""


class TickPath(Protocol):
    """Runs ticks in order, and holds the last one."""

    follows: bool
    """The next tick follows a course that this path knows."""

    @property
    def raw(self) -> RawSample:
        """The sample of the last tick."""

    @property
    def timing(self) -> Timing:
        """The time of the last tick."""

    @property
    def reference(self) -> Reference:
        """The reference of the last tick."""

    @property
    def decision(self) -> Decision:
        """The decision of the last tick."""

    @property
    def state(self) -> TickState:
        """The state after the last tick."""

    @property
    def frozen(self) -> Sequence[float]:
        """The numbers of the state, as `freeze_state` gives them."""

    @property
    def times(self) -> TickTimes:
        """Where in time the loop is."""

    @property
    def output_v(self) -> float:
        """The voltage that the last decision asks for."""

    def begin(self, state: TickState, times: TickTimes) -> None:
        """Begin before the first tick, or afresh with another state."""

    def fits(self, setup: TickSetup) -> bool:
        """Tell whether this path can run a tick of such a set-up: another law may need another."""

    def expect(self, setup: TickSetup | None, running: RunningCourse | None) -> None:
        """Take note of what the next tick may use; None where the loop must ask in that tick."""

    def follow_course(self, wake: Wake, raw: RawSample) -> bool:
        """Run a tick on what was expected; False, and nothing done, where the loop must ask."""

    def time(self, wake: Wake, raw: RawSample) -> Timing:
        """Return the time of a tick that has not run yet."""

    def run(self, setup: TickSetup, wake: Wake, raw: RawSample, reference: Reference) -> None:
        """Run a tick."""

    def rehearse(self, ask: AskAgain, journal: TickJournal) -> None:
        """Run the last tick once more and forget it."""

    def record(self, journal: TickJournal, outcome: TickOutcome, truth: Truth) -> None:
        """Put the last tick into the journal."""


_UNKNOWN = Truth(math.nan, math.nan)
_NO_OUTCOME = TickOutcome(math.nan, 0.0, 0.0, 0.0)


class PlainTick:
    """Runs the tick in plain Python."""

    setup: TickSetup
    timing: Timing
    raw: RawSample
    reference: Reference
    decision: Decision
    state: TickState
    output_v = math.nan
    follows = False

    @property
    def frozen(self) -> Sequence[float]:
        """The numbers of the state."""
        return freeze_state(self.state)

    def begin(self, state: TickState, times: TickTimes) -> None:
        """Begin before the first tick, or afresh with another state."""
        self.state, self.times = state, times

    def fits(self, setup: TickSetup) -> bool:
        """Say yes: plain Python runs every law."""
        return True

    def expect(self, setup: TickSetup | None, running: RunningCourse | None) -> None:
        """Do nothing: plain Python asks in every tick."""

    def follow_course(self, wake: Wake, raw: RawSample) -> bool:
        """Say that the loop must ask."""
        return False

    def time(self, wake: Wake, raw: RawSample) -> Timing:
        """Return the time of a tick that has not run yet."""
        self.timing = make_timing(self.times, wake, raw)
        return self.timing

    def run(self, setup: TickSetup, wake: Wake, raw: RawSample, reference: Reference) -> None:
        """Run a tick, at the time that `time` has returned for it."""
        self.times = TickTimes(self.times.first_t_ns, raw.encoder_t_ns)
        self.setup, self.raw, self.reference = setup, raw, reference
        self.state, self.decision = step(setup, self.state, raw, reference, self.timing)
        self.output_v = output_v(setup.calibration, self.decision.valve_v)

    def rehearse(self, ask: AskAgain, journal: TickJournal) -> None:
        """Run the last tick once more and forget it."""
        again = PlainTick()
        again.begin(self.state, self.times)
        again.timing = self.timing
        try:
            reference = ask(self.timing.t_s) or self.reference
            again.run(self.setup, Wake(0, 0, 0, 0), self.raw, reference)
        except (ArithmeticError, ValueError):  # a tick that fails says so when it is real
            return
        journal.rehearse_tick(again.make_record(_NO_OUTCOME, _UNKNOWN))

    def record(self, journal: TickJournal, outcome: TickOutcome, truth: Truth) -> None:
        """Put the last tick into the journal."""
        journal.put_tick(self.make_record(outcome, truth))

    def make_record(self, outcome: TickOutcome, truth: Truth) -> TickRecord:
        """Return the last tick as a record."""
        state = self.state
        return TickRecord(
            self.timing,
            self.raw,
            state.measurement,
            self.reference,
            state.estimate,
            state.command,
            self.decision,
            outcome,
            truth,
            state.compensated or (),
        )


class CompiledTick:
    """Runs the tick as machine code: one call from the sample to the row of the ring."""

    def __init__(self, library: KernelLibrary, words: TickWords, setup: TickSetup) -> None:
        """Use a library that was built from these words. `setup` is the first one."""
        self._library, self._layout = library, words
        self.words = bytearray(words.words * WORD_BYTES)
        self._row = bytearray(ROW_BYTES)
        self.table = bytearray(TABLE_BYTES)
        self._native, self._arguments = library.bind(self.words, self.words, self._row, self.table)
        self._put_sensed = struct.Struct("<qqqqdqqq").pack_into
        self._sensed_at = words.sensed.begin * WORD_BYTES
        self._get_answer = struct.Struct("<qd").unpack_from
        # Other numbers of the answer are read without the whole of it: every tick needs them.
        self._get_timing = struct.Struct("<qdddq").unpack_from
        self._timing_at = (words.answered.begin + 2) * WORD_BYTES
        self._get_decision = struct.Struct("<dqq").unpack_from
        self._answer_at = words.answered.begin * WORD_BYTES
        self._decision_at = (words.answered.end - len(Decision._fields)) * WORD_BYTES
        self._put_outcome = struct.Struct("<6d").pack_into
        self._setup = setup
        words.setup.write(self.words, setup)
        words.place.write(self.words, NO_COURSE)
        self._course: Course | None = None
        self.follows = False
        """The next tick follows the course that the table has."""
        self._wake = Wake(0, 0, 0, 0)
        self._understudy: CompiledTick | None = None
        self.output_v = math.nan

    # --- the last tick -----------------------------------------------------------------

    @property
    def _sensed(self) -> Sensed:
        return self._layout.sensed.read(self.words)

    @property
    def raw(self) -> RawSample:
        """The sample of the last tick."""
        return self._sensed.raw

    @property
    def timing(self) -> Timing:
        """The time of the last tick."""
        return Timing(*self._get_timing(self.words, self._timing_at))

    @property
    def reference(self) -> Reference:
        """The reference of the last tick."""
        return self._layout.answered.read(self.words).reference

    @property
    def decision(self) -> Decision:
        """The decision of the last tick."""
        valve_v, verdicts, tripped = self._get_decision(self.words, self._decision_at)
        return Decision(valve_v, verdicts, tripped != 0)

    @property
    def state(self) -> TickState:
        """The state after the last tick."""
        return self._layout.state.read(self.words)

    @property
    def frozen(self) -> Sequence[float]:
        """The numbers of the state."""
        return [*map(float, self._layout.state.read_numbers(self.words))]

    # --- the next tick -----------------------------------------------------------------

    def begin(self, state: TickState, times: TickTimes) -> None:
        """Begin before the first tick, or afresh with another state."""
        self._layout.state.write(self.words, state)
        self._layout.times.write(self.words, times)

    @property
    def times(self) -> TickTimes:
        """Where in time the loop is."""
        return self._layout.times.read(self.words)

    def expect(self, setup: TickSetup | None, running: RunningCourse | None) -> None:
        """Take note of what the next tick may use; None where the loop must ask in that tick."""
        self.follows = False
        if setup is None or running is None or not self.fits(setup):
            return
        course, begin_s = running
        if course is not self._course:
            if course.table is None or len(course.table) > len(self.table):
                return
            self.table[: len(course.table)] = course.table
            place = CoursePlace(len(course.segments), 0, begin_s, course.duration_s)
            self._layout.place.write(self.words, place)
            self._course = course
        self._use(setup)
        self.follows = True

    def fits(self, setup: TickSetup) -> bool:
        """Tell whether law and compensation are those that the machine code was built for."""
        built = self._setup
        return type(setup.gains) is type(built.gains) and (
            (setup.compensation is None) == (built.compensation is None)
        )

    def _use(self, setup: TickSetup) -> None:
        if setup is not self._setup:
            self._layout.setup.write(self.words, setup)
            self._setup = setup

    def follow_course(self, wake: Wake, raw: RawSample) -> bool:
        """Run a tick on what was expected; False, and nothing done, where the loop must ask."""
        return self.follows and self._run_native(wake, raw)

    def _run_native(self, wake: Wake, raw: RawSample) -> bool:
        words = self.words
        self._wake = wake
        self._put_sensed(words, self._sensed_at, *wake, *raw)
        if self._native(*self._arguments):
            return False
        is_done, self.output_v = self._get_answer(words, self._answer_at)
        return bool(is_done)

    def time(self, wake: Wake, raw: RawSample) -> Timing:
        """Return the time of a tick that has not run yet."""
        return make_timing(self.times, wake, raw)

    def run(self, setup: TickSetup, wake: Wake, raw: RawSample, reference: Reference) -> None:
        """Run a tick."""
        self._use(setup)
        if self._course is not None:
            self._layout.place.write(self.words, NO_COURSE)
            self._course = None
        self._layout.given.write(self.words, reference)
        if not self._run_native(wake, raw):
            self._run_plain(wake, raw, reference)

    def _run_plain(self, wake: Wake, raw: RawSample, reference: Reference) -> None:
        plain, words = PlainTick(), self.words
        plain.begin(self.state, self.times)
        timing = plain.time(wake, raw)
        plain.run(self._setup, wake, raw, reference)
        self.begin(plain.state, plain.times)
        self.output_v = plain.output_v
        answered = Answered(True, plain.output_v, timing, reference, plain.decision)
        self._layout.answered.write(words, answered)
        packed = tick_struct(self._layout.fields)
        ROW_HEADER.pack_into(self._row, 0, RowKind.TICK, packed.size, timing.tick, raw.encoder_t_ns)
        columns = chain(*plain.make_record(_NO_OUTCOME, _UNKNOWN))
        packed.pack_into(self._row, ROW_HEADER.size, *columns)

    def rehearse(self, ask: AskAgain, journal: TickJournal) -> None:
        """Run the last tick once more and forget it: another of this kind runs it."""
        double = self._understudy
        if double is None:
            double = self._understudy = CompiledTick(self._library, self._layout, self._setup)
        double.words[:] = self.words
        if self._course is not double._course:
            double.table[:] = self.table
            double._course = self._course
        if not self.follows:
            ask(self.timing.t_s)
        wake, raw = self._sensed
        if not double._run_native(wake, raw):
            return
        double._put_outcome(double._row, OUTCOME_AT, *_NO_OUTCOME, *_UNKNOWN)
        journal.rehearse_row(double._row)

    def record(self, journal: TickJournal, outcome: TickOutcome, truth: Truth) -> None:
        """Put the last tick into the journal."""
        self._put_outcome(self._row, OUTCOME_AT, *outcome, *truth)
        wake = self._wake
        journal.put_row(self._row, (wake.now_ns - wake.deadline_ns) * 1e-9, wake.missed)


def load_compiled_tick(
    path: Path, setup: TickSetup, words: TickWords | None = None
) -> CompiledTick:
    """Return the tick of a library that was built for such a set-up.

    `words` may have more than the tick needs. Raises OSError where there is none.
    """
    tick = CompiledTick(KernelLibrary(path), words or TickWords(setup), setup)
    tick.begin(first_state(setup, Zero(0.0, 0.0)), TickTimes(0, 0))
    return tick
