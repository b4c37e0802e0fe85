"""The program of a loop that takes orders: run an experiment, change gains, stop.

Takes the place of the one-run `Program`. Between runs the loop goes on at the safe valve
command: parked. Orders are taken in the slack after a tick, and hold from the next one on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.base.errors import Ending, ExitCode
from pamctl.base.texts import to_json
from pamctl.control.course import make_valve_reference, take_up_course
from pamctl.realtime.program import CuedHelm, OrderSlot, Program
from pamctl.realtime.tick import TickSetup, freeze_state
from pamctl.realtime.tick_runner import RunningCourse, TickRunner
from pamctl.recording.journal import SessionJournal
from pamctl.recording.ring import Ring
from pamctl.signals import Phase, Reference


class _ComingRun(NamedTuple):
    """A run whose ring is being attached."""

    order: Mapping[str, Any]
    ring: Ring
    pages: Iterator[None]


_ALL_THERE = object()


class SteeredProgram(CuedHelm):
    """Program and helm of a loop that outlives its runs."""

    _orders: OrderSlot
    _journal: SessionJournal
    homing = None
    """Of no use to a loop that runs tick by tick."""

    def __init__(
        self,
        orders: OrderSlot,
        journal: SessionJournal,
        setup: TickSetup,
        controller: Mapping[str, object],
        program_of: Callable[[Mapping[str, Any]], Program],
        defer_page_faults: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        """Begin parked and not homed.

        `controller` holds the gains of `setup` as a file has them; `program_of` makes the
        program of an order. Within `defer_page_faults` new memory is mapped and not touched.
        """
        super().__init__(setup, controller, None, journal, orders)
        self._program_of = program_of
        self._defer_page_faults = defer_page_faults
        self._coming: _ComingRun | None = None
        self._safe_valve_v = setup.limits.safe_valve_v
        self._run_ending = Ending(ExitCode.OK, "the program ended")
        self._is_over = False
        self._is_homed = False
        self._valve_v = self._safe_valve_v
        self._is_leaving = False

    # --- what the loop asks in each tick ----------------------------------------------

    def next_reference(self, t_s: float, sample: RawSample) -> tuple[Reference | None, Zero | None]:
        """Return what is asked of the muscle at `t_s`; None when the loop is to end.

        Raises `HomingError`.
        """
        reference, zero = self._ask(t_s, sample)
        if zero is not None:
            self._is_homed = True
        return reference, zero

    @property
    def running(self) -> RunningCourse | None:
        """The course of the present run while only the time decides its reference."""
        return None if self._run is None or self._is_over else self._run.running

    def rehearse_reference(self, t_s: float) -> Reference | None:
        """Return the reference that the present run would give, and change nothing."""
        return None if self._run is None else self._run.rehearse_reference(t_s)

    def _ask(self, t_s: float, sample: RawSample) -> tuple[Reference | None, Zero | None]:
        run = self._run
        if run is None:
            return (None if self._is_leaving else self._parked_reference()), None
        reference, zero = run.next_reference(t_s, sample)
        if reference is None and not run.is_stopping:
            run.begin_stop(t_s, self._valve_v)
            reference, _ = run.next_reference(t_s, sample)
        if reference is None:
            if self._is_leaving:
                return None, zero
            self._is_over = True
            reference = self._parked_reference()
        return reference, zero

    def _parked_reference(self) -> Reference:
        return make_valve_reference(Phase.OPEN_LOOP, self._safe_valve_v)

    # --- the end of the loop itself ------------------------------------------------------

    @property
    def is_stopping(self) -> bool:
        """The smooth stop of the loop has begun."""
        return self._is_leaving

    @property
    def end_reason(self) -> str:
        """Why the present run ends where nothing ends it from outside."""
        return self._run_ending.reason

    def begin_stop(self, t_s: float, valve_v: float) -> None:
        """End the loop: smoothly where a run goes on, at once where it is parked."""
        self._is_leaving = True
        if self._run is not None:
            self._run.begin_stop(t_s, valve_v)

    # --- what the loop lets happen after each tick -----------------------------------------

    def finish_tick(self, done: TickRunner) -> None:
        """Close a run that is over, do what is due, and take an order if there is one."""
        self._valve_v = done.decision.valve_v
        self._journal.close_a_little()
        if self._is_over:
            self._end_run(done)
        super().finish_tick(done)

    def _take_order(self, done: TickRunner) -> None:
        """Take none while a ring is attached: orders hold in their sequence."""
        coming = self._coming
        if coming is not None and not self._is_leaving:
            if next(coming.pages, _ALL_THERE) is _ALL_THERE:
                self._coming = None
                self._begin_run(coming.order, coming.ring, done)
        else:
            super()._take_order(done)

    def _obey(self, order: Mapping[str, Any], done: TickRunner) -> None:
        match order["do"]:
            case "run":
                if order["ring"] is not None:
                    self._coming = self._attach(order)
                elif self._run is not None:  # it may just have ended: without it there is no log
                    self._begin_run(order, None, done)
            case "gains":
                self._change_gains(order, done)
            case "stop":
                self._stop_run(order["reason"], done)
            case _:
                super()._obey(order, done)

    def _attach(self, order: Mapping[str, Any]) -> _ComingRun:
        """Map the ring of an order; a few of its pages are touched after each of the next ticks.

        All at once would take longer than a tick: a ring has megabytes.
        """
        with self._defer_page_faults():
            ring = Ring.attach(order["ring"], populate=False, meta=order.get("meta"))
        return _ComingRun(order, ring, ring.populate_in_steps())

    def _begin_run(self, order: Mapping[str, Any], ring: Ring | None, done: TickRunner) -> None:
        """Begin a run with a log of its own; without a ring it goes on in the present one.

        The course may come with the ring, worked out: to do that here could take seconds.
        """
        now = (done.timing.tick, done.raw.encoder_t_ns)
        if ring is not None:
            self._end_run(done)  # ends the holding of a position
            self._journal.begin_run(ring, *now, self._current_gains(), freeze_state(done.state))
        # All that the program depends on is recorded: a replay runs the program again.
        start = {"start_m": self._position_m(done), "homes": not self._is_homed}
        if ring is not None and ring.cargo_bytes:
            course, text = take_up_course(ring.read_cargo, start["start_m"])
            event = b'{"event":"order","do":"run",' + text + b"," + to_json(start)[1:]
            self._journal.put_event_text(*now, event)
            self._run = self._program_of({**start, "course": course})
        else:
            begin = {"experiment": order["experiment"], "duration_s": order["duration_s"]}
            self._journal.put_event(*now, {"event": "order", "do": "run", **begin, **start})
            self._run = self._program_of({**begin, **start})
        self._run_ending = Ending(ExitCode.OK, self._run.end_reason)
        self._is_homed = True  # if homing fails, the loop ends

    def _change_gains(self, order: Mapping[str, Any], done: TickRunner) -> None:
        if self._run is None:
            self._replace_gains(order["controller"])
        else:
            self._ramp_gains(order["controller"], order["ramp_s"], done)
            self._ordered = order["controller"]

    def _stop_run(self, reason: str, done: TickRunner) -> None:
        if self._run is None or self._run.is_stopping:
            return
        self._run_ending = Ending(ExitCode.OK, reason)
        self._run.begin_stop(done.timing.t_s, self._valve_v)
        event = {"event": "stopping", "reason": reason}
        self._journal.put_event(done.timing.tick, done.raw.encoder_t_ns, event)

    def _end_run(self, done: TickRunner) -> None:
        self._journal.end_run(done.timing.tick, done.raw.encoder_t_ns, self._run_ending)
        self._run, self._is_over = None, False
        if self._controller is not self._ordered:  # a run's own gains end with it
            self._replace_gains(self._ordered)

    def _position_m(self, done: TickRunner) -> float:
        """Return where a motion begins: at the reference, or else at the muscle's position."""
        here_m = done.reference.reference_m
        if not math.isnan(here_m):
            return here_m
        return done.state.measurement.position_m if self._is_homed else 0.0
