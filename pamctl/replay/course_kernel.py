"""Evaluate `Course.at` at many times in one call of a kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pamctl.control.course import CoursePlace, find_course_reference
from pamctl.kernel.calls import machine
from pamctl.signals import Reference

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pamctl.control.course import Course

    Floats = NDArray[np.float64]


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
