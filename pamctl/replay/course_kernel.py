"""A course at many times in one compiled go: what `Course.at` says of each."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from pamctl.compiled import compile_kernel
from pamctl.control.experiment import Segment
from pamctl.control.trajectory import rest_to_rest
from pamctl.signals import Reference

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


def trace_course(
    course: Sequence[Segment], duration_s: float, begin_s: float, t_s: Floats
) -> Floats | None:
    """Return the references of a course that began at `begin_s`; None if it is over by the last.

    `t_s`, of shape (n,), rises; the result has the shape (fields of Reference, n).
    """
    rows = np.empty((len(Reference._fields), len(t_s)))
    done = _compile_retrace()(_tabulate_segments(tuple(course)), duration_s, t_s - begin_s, rows)
    return rows if done == len(t_s) else None


@cache
def _tabulate_segments(course: tuple[Segment, ...]) -> Floats:
    """Return the segments as rows, each with its begin: summed up as a course does it."""
    begin_s, rows = 0.0, []
    for segment in course:
        rows.append((*segment, begin_s))
        begin_s += segment.duration_s
    return np.array(rows)


@cache
def _compile_retrace() -> Callable[..., int]:
    return compile_kernel(retrace)


def retrace(segments: Floats, duration_s: float, t_s: Floats, rows: Floats) -> int:
    """Kernel: fill a column of `rows` for each time; return how many there were until the end."""
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
