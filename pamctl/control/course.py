"""A course: the reference of every moment from homing to the end, and what else falls due."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pamctl.control.course_table import pack_course
from pamctl.control.references.shape import Shape
from pamctl.control.trajectory import rest_to_rest
from pamctl.signals import Reference


class Segment(NamedTuple):
    """One motion, rest, wave or held valve command."""

    phase: int
    duration_s: float
    start_m: float
    end_m: float
    valve_v: float
    """NaN in closed loop."""
    shape: Shape | None = None
    """Takes the place of the motion from start to end, or in open loop of the held command."""


class Cue(NamedTuple):
    """What the loop does beside the reference, once the course has come to a time."""

    at_s: float
    mark: str = ""
    """A remark for the log; empty if gains change."""
    trigger: str = ""
    """The word that the remark consists of, beside its number; empty for other remarks."""
    gains: Mapping[str, Any] | None = None
    """Keys of the controller that change."""
    ramp_s: float = 0.0


class Plan(NamedTuple):
    """An experiment, worked out."""

    segments: tuple[Segment, ...]
    cues: tuple[Cue, ...] = ()
    """In the order of time."""

    @property
    def duration_s(self) -> float:
        """The length of the experiment."""
        return sum(segment.duration_s for segment in self.segments)


def reference_at(segment: Segment, t_s: float) -> Reference:
    """Evaluate a segment `t_s` after its beginning."""
    shape = segment.shape
    if not math.isnan(segment.valve_v):
        valve_v = segment.valve_v if shape is None else shape.at(t_s).position_m
        return make_valve_reference(segment.phase, valve_v)
    if shape is None:
        motion = rest_to_rest(segment.start_m, segment.end_m, segment.duration_s, t_s)
    else:
        motion = shape.at(t_s)
    return Reference(segment.phase, *motion, math.nan)


def make_valve_reference(phase: int, valve_v: float) -> Reference:
    """Return a reference that is a valve command, for open loop."""
    return Reference(phase, math.nan, math.nan, math.nan, math.nan, valve_v)


def start_at_position(course: Sequence[Segment], position_m: float) -> tuple[Segment, ...]:
    """Start a closed-loop course at the muscle's position, instead of at the vented length."""
    first, *others = course
    if math.isnan(first.start_m):
        return tuple(course)
    return (first._replace(start_m=position_m), *others)


class Course:
    """Steps through segments; times must not decrease."""

    def __init__(
        self,
        course: Sequence[Segment],
        duration_s: float | None = None,
        cues: Sequence[Cue] = (),
    ) -> None:
        """Start at the first segment; `duration_s` ends the course early."""
        self.segments: Sequence[Segment] = tuple(course)
        whole_s = sum(segment.duration_s for segment in course)
        self.duration_s = whole_s if duration_s is None else min(duration_s, whole_s)
        self.end_reason = "the experiment is complete"
        """What to say of a run that ends with this course."""
        if self.duration_s < whole_s:
            self.end_reason = (
                f"the duration of {self.duration_s:g} s ended the experiment of {whole_s:g} s"
            )
        self.table = pack_course(self.segments)
        """The segments for machine code; None if it cannot follow them."""
        self.cues: Sequence[Cue] = tuple(cues)
        self._begin()

    @classmethod
    def restore(
        cls,
        segments: Sequence[Segment],
        duration_s: float,
        end_reason: str,
        table: array[float] | None,
        cues: Sequence[Cue],
    ) -> Course:
        """Return a course of which all is known, without a look at its segments."""
        course = cls.__new__(cls)
        course.segments, course.cues, course.table = segments, cues, table
        course.duration_s, course.end_reason = duration_s, end_reason
        course._begin()
        return course

    def _begin(self) -> None:
        self._index = 0
        self._begin_s = 0.0
        self._next_cue = 0

    def at(self, t_s: float) -> Reference | None:
        """Return the reference at `t_s`, or None when the course is over."""
        # The tolerance is half a nanosecond: the time of a tick is a rounded sum of floats.
        if t_s >= self.duration_s - 5e-10:
            return None
        segment = self.segments[self._index]
        while t_s - self._begin_s >= segment.duration_s - 5e-10:
            self._begin_s += segment.duration_s
            self._index += 1
            if self._index == len(self.segments):
                return None
            segment = self.segments[self._index]
        return reference_at(segment, t_s - self._begin_s)

    def rehearse(self, t_s: float) -> Reference | None:
        """Return the reference at `t_s` as the present segment has it, and change nothing."""
        if self._index == len(self.segments):
            return None
        return reference_at(self.segments[self._index], t_s - self._begin_s)

    @property
    def next_cue_s(self) -> float:
        """When the next cue is due, s; infinity if there is none."""
        return self.cues[self._next_cue].at_s if self._next_cue < len(self.cues) else math.inf

    def take_cue(self, t_s: float) -> Cue | None:
        """Return the next cue that is due at `t_s`, each once; None if there is none."""
        at = self._next_cue
        if at == len(self.cues) or t_s < self.cues[at].at_s - 5e-10:
            return None
        self._next_cue = at + 1
        return self.cues[at]
