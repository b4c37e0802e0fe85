"""Evaluate `Course.at` at many times in one compiled call."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from pamctl.compiled import compile_kernel
from pamctl.control.course_table import CoursePlace, find_course_reference
from pamctl.signals import Reference

if TYPE_CHECKING:
    from collections.abc import Callable

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
    done = _compile_trace()(place, np.frombuffer(course.table), t_s, rows)
    return rows if done == len(t_s) else None


@cache
def _compile_trace() -> Callable[..., int]:
    return compile_kernel(trace_table)


def trace_table(place: CoursePlace, table: Floats, t_s: Floats, rows: Floats) -> int:
    """Kernel: fill a column of `rows` for each time; return the number of times before the end."""
    for i in range(len(t_s)):
        place, reference = find_course_reference(place, table, t_s[i])
        if place.segment == place.segments:
            return i
        phase, x, v, a, j, valve_v = reference
        rows[0, i], rows[5, i] = phase, valve_v
        rows[1, i], rows[2, i], rows[3, i], rows[4, i] = x, v, a, j
    return len(t_s)
