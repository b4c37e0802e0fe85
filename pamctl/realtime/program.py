"""The order of a run: home, follow the experiment, stop smoothly.

Marks in the log and other gains are due beside the reference.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.control.course import Course, Cue, make_valve_reference
from pamctl.control.homing import Homing
from pamctl.control.law_registry import read_controller
from pamctl.realtime.gain_ramp import SHORTEST_RAMP_S, GainRamp
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.journal import RingJournal
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
        self.homing = homing
        """The homing that goes on."""
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
        if self.homing is not None:
            reference = self.homing.next_reference(t_s, sample)
            if reference is not None:
                return reference, None
            zero, self.homing = self.homing.zero, None
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
        if begin_s is None or self._stop_begin_s is not None:
            return None
        return self._course, begin_s

    def take_cue(self, t_s: float) -> Cue | None:
        """Return what is due at `t_s` beside the reference, once for each cue."""
        if self._course_begin_s is None or self._stop_begin_s is not None:
            return None
        return self._course.take_cue(t_s - self._course_begin_s)

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
            self.homing = None

    def _ramp_to_safe(self, t_s: float) -> Reference | None:
        assert self._stop_begin_s is not None
        elapsed_s = t_s - self._stop_begin_s
        if elapsed_s >= self._stop_ramp_s:
            return None
        share = elapsed_s / self._stop_ramp_s
        ramp_v = self._stop_from_v + share * (self._safe_valve_v - self._stop_from_v)
        return make_valve_reference(Phase.STOPPING, ramp_v)


class OrderSlot(Protocol):
    """Where orders come from."""

    def take(self) -> dict[str, Any] | None:
        """Return the next order, or None."""


class CuedHelm:
    """The helm of a run: it does what the course has due, in the slack after a tick.

    Gains of the course hold until the end of its run.
    """

    def __init__(
        self,
        setup: TickSetup,
        controller: Mapping[str, Any],
        program: Program | None,
        journal: RingJournal,
        orders: OrderSlot | None = None,
    ) -> None:
        """Begin with the gains of `setup`; `controller` holds them as a file does.

        Marks from outside come from `orders`.
        """
        self._run = program
        self._orders = orders
        self._tuning = GainRamp(setup, read_controller(controller))
        self._ordered = self._controller = controller
        self._gains_said: list[Mapping[str, Any]] = [controller]
        self._journal = journal

    def setup(self, t_s: float) -> TickSetup:
        """Return the set-up with the gains of the moment."""
        return self._tuning.at(t_s)

    @property
    def settled_setup(self) -> TickSetup | None:
        """The set-up of the next tick, whenever it is; None while gains are on a ramp."""
        return self._tuning.settled_setup

    def finish_tick(self, done: TickRunner) -> None:
        """Do what is due, and take an order if there is one."""
        self._obey_cues(done)
        self._take_order(done)

    def _take_order(self, done: TickRunner) -> None:
        order = self._orders.take() if self._orders is not None else None
        if order is not None:
            self._obey(order, done)

    def _obey(self, order: Mapping[str, Any], done: TickRunner) -> None:
        if order["do"] == "mark":
            self._put_mark(order["text"], done)

    def _obey_cues(self, done: TickRunner) -> None:
        """Put the marks that are due, and change the gains from the next tick on."""
        t_s = done.timing.t_s
        while self._run is not None and (cue := self._run.take_cue(t_s)) is not None:
            if cue.gains is None:
                self._put_mark(cue.mark, done)
            else:
                self._ramp_gains({**self._controller, **cue.gains}, cue.ramp_s, done)

    def _put_mark(self, text: str, done: TickRunner) -> None:
        event = {"event": "mark", "text": text}
        self._journal.put_event(done.timing.tick, done.raw.encoder_t_ns, event)

    def _ramp_gains(self, controller: Mapping[str, Any], ramp_s: float, done: TickRunner) -> None:
        """Change the gains on a ramp, and put into the log all that a replay of it needs."""
        timing, ramp_s = done.timing, max(ramp_s, SHORTEST_RAMP_S)
        said = {**controller, "from_t_s": timing.t_s, "ramp_s": ramp_s}
        self._gains_said = [*self._current_gains(), said]
        self._controller = controller
        self._tuning.change(read_controller(controller), timing.t_s, ramp_s)
        self._journal.put_gains(timing.tick, done.raw.encoder_t_ns, said)

    def _replace_gains(self, controller: Mapping[str, Any]) -> None:
        """Take other gains at once: while no law moves the muscle."""
        self._tuning.replace(read_controller(controller))
        self._ordered = self._controller = controller

    def _current_gains(self) -> list[Mapping[str, Any]]:
        """Return the last settled gains, and every change whose ramp is not over."""
        if self._tuning.is_settled:
            self._gains_said = [self._controller]
        return self._gains_said
