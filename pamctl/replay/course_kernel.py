"""Evaluate `Course.at` at many times in one compiled call."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from pamctl.compiled import compile_kernel
from pamctl.control.course import Segment
from pamctl.control.trajectory import rest_to_rest
from pamctl.signals import Reference

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


def trace_course(
    course: Sequence[Segment], duration_s: float, begin_s: float, t_s: Floats
) -> Floats | None:
    """Return the references of a course from `begin_s` on; None if it ends before the last time.

    None too if the course has shapes: only plain Python evaluates those. `t_s`, shape (n,), rises;
    the result has shape (len(Reference._fields), n).
    """
    segments = _tabulate_segments(tuple(course))
    if segments is None:
        return None
    rows = np.empty((len(Reference._fields), len(t_s)))
    done = _compile_trace()(segments, duration_s, t_s - begin_s, rows)
    return rows if done == len(t_s) else None


@cache
def _tabulate_segments(course: tuple[Segment, ...]) -> Floats | None:
    """Return the segments as rows, each with its begin, summed in the same order as in a course.

    None if one has a shape.
    """
    if any(segment.shape is not None for segment in course):
        return None
    begin_s, rows = 0.0, []
    for segment in course:
        rows.append((*segment[:-1], begin_s))
        begin_s += segment.duration_s
    return np.array(rows)


@cache
def _compile_trace() -> Callable[..., int]:
    return compile_kernel(trace_segments)


def trace_segments(segments: Floats, duration_s: float, t_s: Floats, rows: Floats) -> int:
    """Kernel: fill a column of `rows` for each time; return the number of times before the end."""
    index = 0
    for i in range(len(t_s)):
        if t_s[i] >= duration_s - 5e-10:
            return i
        while t_s[i] - segments[index, 5] >= segments[index, 1] - 5e-10:
            index += 1
            if index == len(segments):
                return i
        phase, lasts_s, start_m, end_m, valve_v, begin_s = segments[index]
        rows[0, i] = phase
        rows[5, i] = valve_v
        if math.isnan(valve_v):
            motion = rest_to_rest(start_m, end_m, lasts_s, t_s[i] - begin_s)
            rows[1, i], rows[2, i], rows[3, i], rows[4, i] = motion
        else:
            rows[1:5, i] = math.nan
    return len(t_s)
