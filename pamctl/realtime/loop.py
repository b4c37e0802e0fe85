"""The loop: what happens in every period.

    wake - read - ask - step - write - record

There is one thread, no lock, no log file, and nothing for the garbage collector. Rows go into a
ring in shared memory, and another process writes them to the log.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from hal.calibration import Zero
from hal.rig import RawSample, Rig, RigError, open_rig
from pamctl.base.errors import Ending, ExitCode
from pamctl.control.homing import HomingError
from pamctl.realtime.clock import Clock, Wake
from pamctl.realtime.tick import TickSetup, first_state, rezero_state
from pamctl.realtime.tick_runner import TickRunner
from pamctl.safety import OVERRUNS, explain_verdicts
from pamctl.signals import Decision, Reference, TickOutcome, Timing, Truth

if TYPE_CHECKING:
    from pamctl.realtime.many_ticks import SimulatedTicks
    from pamctl.realtime.program import CuedHelm, Program
    from pamctl.realtime.steering import SteeredProgram
    from pamctl.recording.journal import RingJournal

KEYFRAME_TICKS = 1000


class Supervisor(Protocol):
    """May end the run from outside."""

    def find_stop(self, tick: int) -> Ending | None:
        """Return the ending when the run shall end, else None; the loop then stops smoothly."""

    def wants_abort(self) -> bool:
        """Tell whether to skip the smooth stop."""


_ENDED = Ending(ExitCode.OK, "the program ended")


@dataclass(kw_only=True)
class ControlLoop:
    """The parts of a run. `run` goes to its end and leaves the rig safe and closed."""

    rig: Rig
    clock: Clock
    setup: TickSetup
    nominal_zero: Callable[[RawSample], Zero]
    """The sensors' zeros until homing finds better ones."""
    program: Program | SteeredProgram
    """Gives the reference of each tick."""
    journal: RingJournal
    supervisor: Supervisor
    truth: Callable[[], Truth]
    """What a simulated plant knows."""
    helm: CuedHelm
    """May change the set-up of the tick, and the program, between two ticks."""
    opened: Callable[[], Sequence[Mapping[str, object]]] = tuple
    """Called once, right after the rig is open; returns events for the log."""
    tick: TickRunner = None  # type: ignore[assignment]
    """Runs the ticks; by default one for the set-up."""
    many: SimulatedTicks | None = None
    """Runs those that nothing interrupts."""
    ended: Callable[[Ending], None] = lambda ending: None
    """Told the ending as soon as the valve is safe: to release a device may take seconds."""
    ending: Ending = field(default=_ENDED, init=False)

    def __post_init__(self) -> None:
        self.tick = self.tick or TickRunner(self.setup)

    def run(self) -> Ending:
        """Run the program to its end, as `run_in_steps`; return how it ends."""
        ticks = self.run_in_steps()
        while True:
            try:
                next(ticks)
            except StopIteration as end:
                ending: Ending = end.value
                return ending

    def run_in_steps(self) -> Generator[None, None, Ending]:
        """Run the program; yield after each tick, and leave the rig safe and closed on every path.

        `RigError`, a safety trip and a failed homing become the ending. Anything else is an error
        in pamctl and is raised.
        """
        try:
            with open_rig(self.rig):
                self._record_rig()
                try:
                    ending = yield from self._tick_to_end()
                except HomingError as error:
                    ending = Ending(ExitCode.SAFETY_TRIP, str(error))
                except RigError as error:
                    ending = Ending(ExitCode.UNAVAILABLE, str(error))
                finally:
                    # In this order: until the valve is safe, the guardian counts milliseconds.
                    self.rig.make_safe()
                    self.journal.end_ticks()
                self.ended(ending)
                return ending
        except RigError as error:
            ending = Ending(ExitCode.UNAVAILABLE, str(error))
            self.ended(ending)
            return ending

    def _record_rig(self) -> None:
        noted = self.opened()
        rig = {"event": "rig", **self.rig.describe().as_metadata()}
        for event in (rig, *noted):
            self.journal.put_event(0, self.clock.now_ns(), event)

    def _tick_to_end(self) -> Generator[None, None, Ending]:
        """Tick until the program ends; yield between two ticks."""
        wake = self.clock.wait()
        raw = self.rig.read()
        zero = self.nominal_zero(raw)
        began_ns = raw.encoder_t_ns
        self.tick.begin(first_state(self.setup, zero), began_ns, began_ns - self.clock.period_ns)
        self._record_zero(wake.tick, raw, zero)
        while True:
            sampled_ns = self.clock.now_ns()
            if not self.tick.follow_course(wake, raw) and not self._ask_and_run(wake, raw):
                return self.ending
            self._act(wake, sampled_ns)
            ended = self._finish(wake.tick, wake.missed, raw)
            while ended is None and self._run_many():
                ended = self._finish(self.tick.timing.tick, 0, self.tick.raw)
            if ended is not None:
                return ended
            yield
            wake = self.clock.wait(self._rehearse)
            raw = self.rig.read()

    def _finish(self, at: int, missed: int, raw: RawSample) -> Ending | None:
        """Do what is due in the slack after tick `at`; return how the run ends if it does."""
        tick, decision = self.tick, self.tick.decision
        # The last tick of each thousand, or the first one after it if that was missed.
        if (at + 1) % KEYFRAME_TICKS <= missed:
            self.journal.put_keyframe(at, raw.encoder_t_ns, tick.frozen)
        if decision.tripped:
            return self._end_tripped(at, raw, decision)
        # The abort is read first. Two signals between the two reads are then a stop in this
        # tick and an abort in the next one, and the run never ends without its reason.
        abort = self.supervisor.wants_abort()
        self._obey_supervisor(at, raw, decision)
        self.settle()
        return self.ending if abort else None

    def settle(self) -> None:
        """Do what is due beside the reference, such as an order, before the next tick."""
        self.helm.finish_tick(self.tick)
        self.tick.expect(self.helm.settled_setup, self.program.running)

    def _run_many(self) -> bool:
        """Run the ticks up to the next frozen state or cue at once, where that is possible.

        Without a course, those for which the homing that goes on asks for the same.
        """
        many, tick, homing = self.many, self.tick, self.program.homing
        if tick.follows and self.program.running is not None:
            (course, begin_s), homing = self.program.running, None
            due_s = begin_s + course.next_cue_s
        elif homing is not None and self.helm.settled_setup is tick.setup:
            due_s = homing.holds_until_s
        else:
            return False
        if many is None:
            return False
        timing, period_s = tick.timing, self.clock.period_ns * 1e-9
        until_frozen = KEYFRAME_TICKS - (timing.tick + 1) % KEYFRAME_TICKS
        until_due = max((due_s - timing.t_s) / period_s - 2.0, 0.0)
        ticks = int(min(until_frozen, until_due))
        done = many.run(tick, timing.tick + 1, ticks, self.journal)
        if homing is not None:
            for sample in many.samples(done):
                homing.take(sample)
        return done > 0

    def _ask_and_run(self, wake: Wake, raw: RawSample) -> bool:
        """Ask program and helm, and run the tick; return False at the end of the program."""
        timing = self.tick.time(wake, raw)
        setup = self.helm.setup(timing.t_s)
        tick = self.tick
        reference, zero = self._ask(timing, raw)
        if zero is not None:
            tick.restart(rezero_state(setup, tick.state, zero))
            self._record_zero(timing.tick, raw, zero)
        if reference is None:
            return False
        tick.run(setup, wake, raw, reference)
        return True

    def _ask(self, timing: Timing, raw: RawSample) -> tuple[Reference | None, Zero | None]:
        """Return the program's reference; when the experiment is over, begin the smooth stop."""
        reference, zero = self.program.next_reference(timing.t_s, raw)
        if reference is None and not self.program.is_stopping:
            self.ending = Ending(ExitCode.OK, self.program.end_reason)
            self._begin_stop(timing, raw, self.tick.state.safety.valve_v)
            reference, _ = self.program.next_reference(timing.t_s, raw)
        return reference, zero

    def _obey_supervisor(self, at: int, raw: RawSample, decision: Decision) -> None:
        """Check, in the slack after the tick, whether the run shall end."""
        if not self.program.is_stopping:
            wanted = self.supervisor.find_stop(at)
            if wanted is not None:
                self.ending = wanted
                self._begin_stop(self.tick.timing, raw, decision.valve_v)

    def _begin_stop(self, timing: Timing, raw: RawSample, valve_v: float) -> None:
        last_v = self.setup.limits.safe_valve_v if math.isnan(valve_v) else valve_v
        self.program.begin_stop(timing.t_s, last_v)
        event = {"event": "stopping", "reason": self.ending.reason}
        self.journal.put_event(timing.tick, raw.encoder_t_ns, event)

    def _act(self, wake: Wake, sampled_ns: int) -> None:
        """Write to the valve and record the tick, even if the write fails."""
        now_ns = self.clock.now_ns
        decided_ns = now_ns()
        applied_v = math.nan
        try:
            applied_v = self.rig.write(self.tick.output_v)
        finally:
            outcome = TickOutcome(
                applied_v,
                (sampled_ns - wake.now_ns) * 1e-9,
                (decided_ns - sampled_ns) * 1e-9,
                (now_ns() - decided_ns) * 1e-9,
            )
            self.tick.record(self.journal, outcome, self.truth())

    def _rehearse(self) -> None:
        """Run the last tick once more and forget it: the caches are warm for the next one."""
        self.tick.rehearse(self.program.rehearse_reference, self.journal)

    def _record_zero(self, tick: int, raw: RawSample, zero: Zero) -> None:
        """Record from which tick on the sensors have other zeros: replay needs it."""
        self.journal.put_event(tick, raw.encoder_t_ns, {"event": "zeroed", **zero._asdict()})

    def _end_tripped(self, at: int, raw: RawSample, decision: Decision) -> Ending:
        self.rig.make_safe()
        reasons = explain_verdicts(decision.verdicts)
        event: dict[str, object] = {"event": "tripped", "reasons": reasons}
        self.journal.put_event(at, raw.encoder_t_ns, event)
        overruns_only = decision.verdicts == OVERRUNS
        code = ExitCode.OVERRUNS if overruns_only else ExitCode.SAFETY_TRIP
        return Ending(code, "safety trip: " + "; ".join(reasons))
