"""The order of a run: home, follow the experiment, stop smoothly."""

from __future__ import annotations

import math

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.control.course import Course, Cue, make_valve_reference
from pamctl.control.homing import Homing
from pamctl.signals import Phase, Reference


class Program:
    """Gives the reference of every tick.

    New zeros come in the tick in which homing ends. Positions and pressures are new from there
    on, and the tick's state must start anew.
    """

    def __init__(
        self,
        homing: Homing | None,
        course: Course,
        *,
        safe_valve_v: float,
        stop_ramp_s: float,
        course_begin_s: float | None = None,
    ) -> None:
        """Without homing the experiment begins at once, or began at `course_begin_s`."""
        self._homing = homing
        self._course = course
        self._safe_valve_v = safe_valve_v
        self._stop_ramp_s = stop_ramp_s
        self._course_begin_s = course_begin_s
        self._stop_begin_s: float | None = None
        self._stop_from_v = safe_valve_v

    def next_reference(self, t_s: float, sample: RawSample) -> tuple[Reference | None, Zero | None]:
        """Return the reference at `t_s`, or None at the end; and the zeros just found.

        Raises `HomingError`.
        """
        if self._stop_begin_s is not None:
            return self._ramp_to_safe(t_s), None
        zero = None
        if self._homing is not None:
            reference = self._homing.next_reference(t_s, sample)
            if reference is not None:
                return reference, None
            zero, self._homing = self._homing.zero, None
        if self._course_begin_s is None:
            self._course_begin_s = t_s
        return self._course.at(t_s - self._course_begin_s), zero

    def rehearse_reference(self, t_s: float) -> Reference | None:
        """Return the reference at `t_s` of a course that is under way, and change nothing."""
        if self._course_begin_s is None or self._stop_begin_s is not None:
            return None
        return self._course.rehearse(t_s - self._course_begin_s)

    @property
    def running(self) -> tuple[Course, float] | None:
        """The course and its begin (s) while only the time decides the reference; else None."""
        begin_s = self._course_begin_s
        if begin_s is None or self._homing is not None or self._stop_begin_s is not None:
            return None
        return self._course, begin_s

    def take_cue(self, t_s: float) -> Cue | None:
        """Return what is due at `t_s` beside the reference, once for each cue."""
        if self._course_begin_s is None or self._stop_begin_s is not None:
            return None
        return self._course.take_cue(t_s - self._course_begin_s)

    @property
    def next_cue_s(self) -> float:
        """When the next cue is due, s; infinity if there is none."""
        if self._course_begin_s is None or self._stop_begin_s is not None:
            return math.inf
        return self._course_begin_s + self._course.next_cue_s

    @property
    def is_stopping(self) -> bool:
        """The smooth stop has begun."""
        return self._stop_begin_s is not None

    @property
    def end_reason(self) -> str:
        """Why the course ends: the experiment is complete, or its duration was limited."""
        return self._course.end_reason

    def begin_stop(self, t_s: float, valve_v: float) -> None:
        """Go from the present valve command to the safe one on a ramp."""
        if self._stop_begin_s is None:
            self._stop_begin_s = t_s
            self._stop_from_v = valve_v

    def _ramp_to_safe(self, t_s: float) -> Reference | None:
        assert self._stop_begin_s is not None
        elapsed_s = t_s - self._stop_begin_s
        if elapsed_s >= self._stop_ramp_s:
            return None
        share = elapsed_s / self._stop_ramp_s
        ramp_v = self._stop_from_v + share * (self._safe_valve_v - self._stop_from_v)
        return make_valve_reference(Phase.STOPPING, ramp_v)
