"""A course as a table of numbers, which a kernel can follow.

Row: phase, duration, start, end, valve command, begin. The begins are summed in the same order as
in `Course.at`, so both give the same bits.
"""

from __future__ import annotations

from array import array
from math import isnan, nan
from typing import TYPE_CHECKING, Any, NamedTuple

from pamctl.control.trajectory import rest_to_rest
from pamctl.signals import Reference

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pamctl.control.course import Segment

SEGMENT_WORDS = 6


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
