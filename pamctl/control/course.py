"""A course: the reference of every moment from homing to the end, and what else falls due.

`Course` steps through segments in plain Python. As a table of numbers a kernel can follow it, and
packed in pieces another process can take it up at once, however many segments it has.
"""

from __future__ import annotations

import math
import pickle
import struct
from array import array
from collections.abc import Callable, Mapping, Sequence
from math import isnan, nan
from typing import Any, NamedTuple

from pamctl.control.waves import Shape, rest_to_rest
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


# --- as a table of numbers ----------------------------------------------------------------

SEGMENT_WORDS = 6
"""Of a row: phase, duration, start, end, valve command, begin.

The begins are summed in the same order as in `Course.at`, so both give the same bits.
"""


class CoursePlace(NamedTuple):
    """A course as a table of segments, and the segment that it has come to."""

    segments: int
    """Number of rows of the table; 0: the reference is given from outside."""
    segment: int
    begin_s: float
    """Time of the loop at which the course began."""
    duration_s: float


NO_COURSE = CoursePlace(0, 0, 0.0, 0.0)


def find_course_reference(
    place: CoursePlace, table: Any, t_s: float
) -> tuple[CoursePlace, Reference]:
    """Kernel: do what `Course.at` does, on a table. Its segment is `segments` when it is over."""
    t_s = t_s - place.begin_s
    index = place.segment
    if t_s >= place.duration_s - 5e-10:
        index = place.segments
    while index < place.segments:
        at = index * SEGMENT_WORDS
        if not t_s - table[at + 5] >= table[at + 1] - 5e-10:
            break
        index += 1
    place = CoursePlace(place.segments, index, place.begin_s, place.duration_s)
    if index == place.segments:
        return place, Reference(0, nan, nan, nan, nan, nan)
    at = index * SEGMENT_WORDS
    phase, valve_v = int(table[at]), table[at + 4]
    if not isnan(valve_v):
        return place, Reference(phase, nan, nan, nan, nan, valve_v)
    x, v, a, j = rest_to_rest(table[at + 2], table[at + 3], table[at + 1], t_s - table[at + 5])
    return place, Reference(phase, x, v, a, j, nan)


def pack_course(segments: Sequence[Segment]) -> array[float] | None:
    """Return the rows of a table, one after the other; None if a segment has a shape.

    Shapes are evaluated by plain Python only.
    """
    if any(segment.shape is not None for segment in segments):
        return None
    begin_s, numbers = 0.0, array("d")
    for phase, duration_s, start_m, end_m, valve_v, _ in segments:
        numbers.extend((phase, duration_s, start_m, end_m, valve_v, begin_s))
        begin_s += duration_s
    return numbers


# --- for another process ------------------------------------------------------------------

# number of items | place and size of each | items
#
# The items are a head, a text, the segments and the cues, each packed on its own: the process that
# follows the course unpacks one when it comes to it. Both are of one program and one user.
_COUNT = struct.Struct("<Q")
_PLACE = struct.Struct("<QQ")
_BEFORE_SEGMENTS = 2
_LONGEST_TABLE = 1 << 13
"""Numbers; to take up a longer one would take too much of a tick."""

Read = Callable[[int, int], bytes]
"""Returns so many bytes from a place on: `read(start, size)`."""


def pack_handed_course(course: Course, text: bytes) -> bytes:
    """Pack a course that has not begun, and a text about it."""
    table = course.table
    if table is not None and len(table) > _LONGEST_TABLE:
        table = None
    head = (len(course.segments), course.duration_s, course.end_reason, table)
    items = [head, text, *course.segments, *course.cues]
    places, packed = array("Q"), bytearray()
    known: dict[int, tuple[int, int]] = {}  # a wave repeats the same segments many thousand times
    begin = _COUNT.size + len(items) * _PLACE.size
    for item in items:
        if id(item) not in known:
            piece = pickle.dumps(item)
            known[id(item)] = begin + len(packed), len(piece)
            packed += piece
        places.extend(known[id(item)])
    return b"".join((_COUNT.pack(len(items)), places.tobytes(), packed))


class _Items(Sequence[Any]):
    """Some of the items, of which the first may be another; the last one asked for is kept."""

    def __init__(self, read: Read, begin: int, end: int, first: Any = None) -> None:
        self._read, self._begin, self._end, self._first = read, begin, end, first
        self._at, self._item = -1, None

    def __len__(self) -> int:
        return self._end - self._begin

    def __getitem__(self, index: Any) -> Any:
        at = range(self._begin, self._end)[index]
        if at == self._begin and self._first is not None:
            return self._first
        if at != self._at:
            place = self._read(_COUNT.size + at * _PLACE.size, _PLACE.size)
            self._at, self._item = at, pickle.loads(self._read(*_PLACE.unpack(place)))
        return self._item


def take_up_course(read: Read, start_m: float) -> tuple[Course, bytes]:
    """Return the course, begun at a position as `start_at_position` does it, and the text.

    `read` is called as long as the course is followed.
    """
    (count,) = _COUNT.unpack(read(0, _COUNT.size))
    head, text = _Items(read, 0, _BEFORE_SEGMENTS)
    cues_at = _BEFORE_SEGMENTS + head[0]
    segments: Sequence[Segment] = _Items(read, _BEFORE_SEGMENTS, cues_at)
    _, duration_s, end_reason, table = head
    (first,) = start_at_position((segments[0],), start_m)
    if first != segments[0]:
        segments = _Items(read, _BEFORE_SEGMENTS, cues_at, first)
        table = table and pack_course((first,)) + table[SEGMENT_WORDS:]
    cues = _Items(read, cues_at, count)
    return Course.restore(segments, duration_s, end_reason, table, cues), text
