"""The whole tick as one kernel: timing, the course's reference, step.

The loop calls its parts in turn where it runs in plain Python; machine code has them in one call.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from hal.calibration import output_v
from hal.rig import RawSample
from pamctl.control.course_table import CoursePlace, find_course_reference
from pamctl.realtime.clock import Wake
from pamctl.realtime.tick import TickSetup, TickState, step
from pamctl.signals import Decision, Reference, Timing


class TickTimes(NamedTuple):
    """Where in time the loop is."""

    first_t_ns: int
    last_t_ns: int


class WholeTick(NamedTuple):
    """The results of one tick."""

    is_done: bool
    """False: the course is over, nothing was computed, and the program must be asked."""
    state: TickState
    times: TickTimes
    place: CoursePlace
    timing: Timing
    reference: Reference
    decision: Decision
    output_v: float
    """The voltage that the decision asks for."""


def run_whole_tick(
    setup: TickSetup,
    state: TickState,
    times: TickTimes,
    place: CoursePlace,
    wake: Wake,
    raw: RawSample,
    given: Reference,
    table: Any,
) -> WholeTick:
    """Kernel: run one tick; `table` has the rows of `pamctl.control.course_table`.

    `given` is the reference where there is no course.
    """
    timing = make_timing(times, wake, raw)
    reference = given
    if place.segments > 0:
        place, reference = find_course_reference(place, table, timing.t_s)
        if place.segment == place.segments:
            unmoved = Decision(0.0, 0, False)
            return WholeTick(False, state, times, place, timing, reference, unmoved, 0.0)
    state, decision = step(setup, state, raw, reference, timing)
    times = TickTimes(times.first_t_ns, raw.encoder_t_ns)
    volts = output_v(setup.calibration, decision.valve_v)
    return WholeTick(True, state, times, place, timing, reference, decision, volts)


def make_timing(times: TickTimes, wake: Wake, raw: RawSample) -> Timing:
    """Return the time of a tick."""
    return Timing(
        wake.tick,
        (raw.encoder_t_ns - times.first_t_ns) * 1e-9,
        (raw.encoder_t_ns - times.last_t_ns) * 1e-9,
        (wake.now_ns - wake.deadline_ns) * 1e-9,
        wake.missed,
    )
