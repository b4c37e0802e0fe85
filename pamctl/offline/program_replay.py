"""Run the program of a run again: its references at the logged times, and the zeros it finds.

Homing gets the logged raw samples, and a stop begins in the same tick as in the log. Everything
else follows from the settings.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.control.course import Course, CoursePlace, find_course_reference, make_valve_reference
from pamctl.control.homing import HomingError
from pamctl.kernel.calls import machine
from pamctl.offline.replay_source import LONGEST_STRETCH, ReplaySource
from pamctl.realtime.program import Program
from pamctl.settings.build import build_ordered_program, build_program, nominal_zero_of
from pamctl.signals import Phase, Reference

Floats = NDArray[np.float64]

_NOTHING = (-1.0, math.nan, math.nan, math.nan, math.nan, math.nan)
"""Reference of a program that is over or refuses to home; -1 is not a phase."""

_BY_HISTORY = (Phase.HOMING, Phase.STOPPING)
"""Phases that depend on earlier ticks; all others depend on time only."""


class ProgramAnswer(NamedTuple):
    """The program's references and zeros in a stretch of ticks."""

    references: NDArray[np.float64]
    """Shape (len(Reference._fields), n)."""
    zeros: dict[int, Zero]
    """Zeros that it found, by the first tick that uses them."""


class ProgramReplay:
    """Runs the program through the ticks of a log in order, from any tick on."""

    def __init__(self, recording: ReplaySource, begin: int, *, plain: bool = False) -> None:
        """If the homing lies before `begin`, the program continues after it.

        `plain` runs it tick by tick, as the loop does.
        """
        self._recording = recording
        self._plain = plain
        self._phase = recording.log["phase"]
        self._valve_v = recording.log["valve_v"]
        self._safe_v = recording.setup_at(0).limits.safe_valve_v
        self._parked = make_valve_reference(Phase.OPEN_LOOP, self._safe_v)
        knows_start = 0 not in recording.losses and -1 not in recording.keyframes
        self._is_first = begin == 0 and knows_start and not recording.orders
        self._program = (
            build_program(recording.settings) if self._is_first else self._resume_program(begin)
        )

    def ask(self, begin: int, end: int) -> ProgramAnswer | None:
        """Return the references from `begin` to before `end`; None if the log does not tell.

        Call it for all stretches in order.
        """
        if begin in self._recording.orders:
            self._program = self._resume_order(begin)
        if begin in self._recording.losses and begin > 0:
            phases = {*self._phase[begin - 1 : begin + 1].tolist()}
            if not phases.isdisjoint(_BY_HISTORY):
                self._program = None
        if self._program is None:
            self._program = self._resume_program(begin)
        if self._program is None:
            return None
        answer = None if self._plain else self._trace_course(self._program, begin, end)
        return answer or self._ask_tick_by_tick(self._program, begin, end)

    def _trace_course(self, program: Program, begin: int, end: int) -> ProgramAnswer | None:
        """Return the references of a course in one go; None where only the program can tell."""
        if program.running is None or self._recording.stops & set(range(begin, end)):
            return None
        course, course_begin_s = program.running
        t_s = self._recording.log.t[begin:end]
        rows = trace_course(course, course_begin_s, t_s)
        return None if rows is None else ProgramAnswer(rows, {})

    def _resume_program(self, begin: int) -> Program | None:
        """Return a program that has run up to `begin`; None if the log does not tell how."""
        recording, times_s = self._recording, self._recording.log.t
        if recording.orders:
            return self._resume_order(begin)
        if recording.cut.get("has_orders") == "true":  # the order itself was cut away
            return None
        if not recording.settings.rig.homing.enabled:
            course_begin_s = 0.0
        elif homed := [tick for tick in recording.zeros if 0 < tick <= begin]:
            course_begin_s = float(times_s[max(homed)])
        elif homed_t_s := recording.cut.get("homed_t_s"):
            course_begin_s = float(homed_t_s)
        else:
            return None
        program = build_program(recording.settings, course_begin_s=course_begin_s)
        for stop in (tick for tick in recording.stops if tick < begin):
            # The stop came in the tick before or, at the end of a course, in this tick.
            at_once = self._phase[stop] == Phase.STOPPING
            last_v = self._valve_v_before(stop) if at_once else float(self._valve_v[stop])
            self._begin_stop(program, float(times_s[stop]), last_v)
        if self._phase[begin] == Phase.STOPPING and begin not in recording.stops:
            return program if program.is_stopping else None
        return program

    def _resume_order(self, begin: int) -> Program | None:
        """Run the last ordered program up to `begin`; None if the log lost ticks of it."""
        ordered_at = max((tick for tick in self._recording.orders if tick <= begin), default=None)
        if ordered_at is None or self._recording.losses & set(range(ordered_at, begin + 1)):
            return None
        program = build_ordered_program(
            self._recording.settings, self._recording.orders[ordered_at]
        )
        for start in range(ordered_at, begin, LONGEST_STRETCH):
            self._ask_tick_by_tick(program, start, min(start + LONGEST_STRETCH, begin))
        return program

    def _ask_tick_by_tick(self, program: Program, begin: int, end: int) -> ProgramAnswer:
        inputs = self._recording.inputs(begin, end)
        samples = map(
            RawSample,
            inputs["pressure_v"].tolist(),
            inputs["encoder_counts"].tolist(),
            inputs["pressure_t_ns"].tolist(),
            inputs["encoder_t_ns"].tolist(),
        )
        written_v = self._valve_v[begin:end].tolist()
        last_v = self._valve_v_before(begin)
        rows: list[tuple[float, ...]] = []
        zeros: dict[int, Zero] = {}
        for tick, t_s, sample, valve_v in zip(
            range(begin, end), inputs["t_s"].tolist(), samples, written_v, strict=True
        ):
            if self._is_first:
                zeros[tick] = nominal_zero_of(self._recording.settings)(sample)
                self._is_first = False
            reference, zero = self._ask_once(program, t_s, sample, last_v)
            if reference is None and self._recording.orders and program.is_stopping:
                reference = self._parked  # the loop goes on after the end of a run
            rows.append(_NOTHING if reference is None else reference)
            if zero is not None:
                zeros[tick] = zero
            last_v = valve_v
            if tick in self._recording.stops:
                self._begin_stop(program, t_s, last_v)
        return ProgramAnswer(
            np.array(rows, dtype=np.float64).reshape(-1, len(Reference._fields)).T, zeros
        )

    def _ask_once(
        self, program: Program, t_s: float, sample: RawSample, last_v: float
    ) -> tuple[Reference | None, Zero | None]:
        """Ask for one reference as the loop does: at its end, a course begins its stop at once."""
        try:
            reference, zero = program.next_reference(t_s, sample)
        except HomingError:
            return None, None
        if reference is None and not program.is_stopping:
            self._begin_stop(program, t_s, last_v)
            reference, _ = program.next_reference(t_s, sample)
        return reference, zero

    def _valve_v_before(self, tick: int) -> float:
        return self._safe_v if tick == 0 else float(self._valve_v[tick - 1])

    def _begin_stop(self, program: Program, t_s: float, valve_v: float) -> None:
        program.begin_stop(t_s, self._safe_v if math.isnan(valve_v) else valve_v)


def trace_course(course: Course, begin_s: float, t_s: Floats) -> Floats | None:
    """Return the references of a course from `begin_s` on; None if it ends before the last time.

    None too if the course has shapes: only plain Python evaluates those. `t_s`, shape (n,), rises;
    the result has shape (len(Reference._fields), n).
    """
    if course.table is None:
        return None
    place = CoursePlace(len(course.segments), 0, begin_s, course.duration_s)
    rows = np.empty((len(Reference._fields), len(t_s)))
    done = np.zeros(1, dtype=np.int64)
    machine(fill_course)(place, np.frombuffer(course.table), t_s, rows, done)
    return rows if done[0] == len(t_s) else None


def fill_course(
    place: CoursePlace, table: Floats, t_s: Floats, rows: Floats, done: NDArray[np.int64]
) -> None:
    """Kernel: fill a column of `rows` for each time before the end, and their number."""
    for i in range(len(t_s)):
        place, reference = find_course_reference(place, table, t_s[i])
        if place.segment == place.segments:
            return
        phase, x, v, a, j, valve_v = reference
        rows[0, i], rows[5, i] = phase, valve_v
        rows[1, i], rows[2, i], rows[3, i], rows[4, i] = x, v, a, j
        done[0] = i + 1
