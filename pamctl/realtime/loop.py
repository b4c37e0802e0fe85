"""The loop: what happens in every period.

    wake - read - ask - step - write - record

There is one thread, no lock, no log file, and nothing for the garbage collector. Rows go into a
ring in shared memory, and another process writes them to the log.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from hal.calibration import Zero, output_v
from hal.rig import RawSample, Rig, RigError, open_rig
from pamctl.control.homing import HomingError
from pamctl.exit_codes import Ending, ExitCode
from pamctl.realtime.clock import Clock, Wake
from pamctl.realtime.keyframe import freeze_state
from pamctl.realtime.tick import TickSetup, TickState, first_state, rezero_state, step
from pamctl.safety import OVERRUNS, explain_verdicts
from pamctl.signals import Decision, Reference, TickOutcome, TickRecord, Timing, Truth

KEYFRAME_TICKS = 1000


class Journal(Protocol):
    """Takes what must not be lost. Its methods raise `RingFull` where there is no room."""

    def put_tick(self, record: TickRecord) -> None:
        """Keep a tick."""

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        """Keep an event; its key `event` names it."""

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        """Keep the frozen state after a tick."""

    def end_ticks(self) -> None:
        """Take note that the valve is safe and will not be moved again."""


class Helm(Protocol):
    """May change the set-up of the tick, and the program, between two ticks."""

    def setup(self, t_s: float) -> TickSetup:
        """Return the set-up of the tick at `t_s`."""

    def finish_tick(self, timing: Timing, raw: RawSample, state: TickState) -> None:
        """Take note that a tick is done; changes hold from the next tick on."""


class FixedHelm:
    """The helm of a single run: nothing changes."""

    def __init__(self, setup: TickSetup) -> None:
        """Use `setup` in every tick."""
        self._setup = setup

    def setup(self, t_s: float) -> TickSetup:
        """Return the one set-up."""
        return self._setup

    def finish_tick(self, timing: Timing, raw: RawSample, state: TickState) -> None:
        """Do nothing."""


class ReferenceSource(Protocol):
    """Gives the reference of each tick: `Program`, or a program that takes orders."""

    @property
    def is_stopping(self) -> bool:
        """The smooth stop has begun."""

    @property
    def end_reason(self) -> str:
        """Why it ends where nothing ends it from outside."""

    def next_reference(self, t_s: float, sample: RawSample) -> tuple[Reference | None, Zero | None]:
        """Return the reference at `t_s`, or None at the end; and the zeros just found."""

    def begin_stop(self, t_s: float, valve_v: float) -> None:
        """Go from the present valve command to the safe one on a ramp."""


class Supervisor(Protocol):
    """May end the run from outside."""

    def find_stop(self, tick: int) -> Ending | None:
        """Return the ending when the run shall end, else None; the loop then stops smoothly."""

    def wants_abort(self) -> bool:
        """Tell whether to skip the smooth stop."""


class _Times(NamedTuple):
    """Where in time the loop is."""

    first_t_ns: int
    last_t_ns: int


def run_loop(
    rig: Rig,
    clock: Clock,
    setup: TickSetup,
    nominal_zero: Callable[[RawSample], Zero],
    program: ReferenceSource,
    journal: Journal,
    supervisor: Supervisor,
    truth: Callable[[], Truth],
    helm: Helm | None = None,
    opened: Callable[[], Sequence[Mapping[str, object]]] = tuple,
) -> Ending:
    """Run the program to its end; leave the rig safe and closed on every path.

    `nominal_zero` gives the sensors' zeros until homing finds better ones; `truth` is what
    a simulated plant knows. Without a `helm` the set-up stays as it is. `opened` is called once,
    right after the rig is open, and returns events for the log. `RigError`, a safety
    trip and a failed homing become the ending. Anything else is an error in pamctl and is raised.
    """
    try:
        with open_rig(rig):
            noted = opened()
            journal.put_event(0, clock.now_ns(), {"event": "rig", **rig.describe().as_metadata()})
            for event in noted:
                journal.put_event(0, clock.now_ns(), event)
            helm = helm or FixedHelm(setup)
            loop = _Loop(rig, clock, setup, helm, nominal_zero, program, journal, supervisor, truth)
            try:
                return loop.run()
            finally:
                # In this order: until the valve is safe, the guardian counts milliseconds.
                rig.make_safe()
                journal.end_ticks()
    except RigError as error:
        return Ending(ExitCode.UNAVAILABLE, str(error))
    except HomingError as error:
        return Ending(ExitCode.SAFETY_TRIP, str(error))


_ENDED = Ending(ExitCode.OK, "the program ended")


@dataclass
class _Loop:
    """The parts of the loop, and its ending."""

    rig: Rig
    clock: Clock
    setup: TickSetup
    helm: Helm
    nominal_zero: Callable[[RawSample], Zero]
    program: ReferenceSource
    journal: Journal
    supervisor: Supervisor
    truth: Callable[[], Truth]
    ending: Ending = _ENDED

    def run(self) -> Ending:
        """Tick until the program ends."""
        wake = self.clock.wait()
        raw = self.rig.read()
        state = first_state(self.setup, self.nominal_zero(raw))
        self._record_zero(wake.tick, raw, state.zero)
        times = _Times(raw.encoder_t_ns, raw.encoder_t_ns - self.clock.period_ns)
        while True:
            sampled_ns = self.clock.now_ns()
            timing = _make_timing(times, wake, raw)
            times = times._replace(last_t_ns=raw.encoder_t_ns)
            reference, zero = self._ask(timing, raw, state)
            if zero is not None:
                state = rezero_state(self.helm.setup(timing.t_s), state, zero)
                self._record_zero(timing.tick, raw, zero)
            if reference is None:
                return self.ending
            setup = self.helm.setup(timing.t_s)
            state, decision = step(setup, state, raw, reference, timing)
            self._act(wake, sampled_ns, timing, raw, reference, state, decision)
            if decision.tripped:
                return self._end_tripped(timing, raw, decision)
            # The abort is read first. Two signals between the two reads are then a stop in this
            # tick and an abort in the next one, and the run never ends without its reason.
            abort = self.supervisor.wants_abort()
            self._obey_supervisor(timing, raw, decision)
            self.helm.finish_tick(timing, raw, state)
            if abort:
                return self.ending
            wake = self.clock.wait()
            raw = self.rig.read()

    def _ask(
        self, timing: Timing, raw: RawSample, state: TickState
    ) -> tuple[Reference | None, Zero | None]:
        """Return the program's reference; when the experiment is over, begin the smooth stop."""
        reference, zero = self.program.next_reference(timing.t_s, raw)
        if reference is None and not self.program.is_stopping:
            self.ending = Ending(ExitCode.OK, self.program.end_reason)
            self._begin_stop(timing, raw, state.safety.valve_v)
            reference, _ = self.program.next_reference(timing.t_s, raw)
        return reference, zero

    def _obey_supervisor(self, timing: Timing, raw: RawSample, decision: Decision) -> None:
        """Check, in the slack after the tick, whether the run shall end."""
        if not self.program.is_stopping:
            wanted = self.supervisor.find_stop(timing.tick)
            if wanted is not None:
                self.ending = wanted
                self._begin_stop(timing, raw, decision.valve_v)

    def _begin_stop(self, timing: Timing, raw: RawSample, valve_v: float) -> None:
        last_v = self.setup.limits.safe_valve_v if math.isnan(valve_v) else valve_v
        self.program.begin_stop(timing.t_s, last_v)
        event = {"event": "stopping", "reason": self.ending.reason}
        self.journal.put_event(timing.tick, raw.encoder_t_ns, event)

    def _act(
        self,
        wake: Wake,
        sampled_ns: int,
        timing: Timing,
        raw: RawSample,
        reference: Reference,
        state: TickState,
        decision: Decision,
    ) -> None:
        """Write to the valve and record the tick, even if the write fails."""
        now_ns = self.clock.now_ns
        decided_ns = now_ns()
        applied_v = math.nan
        try:
            applied_v = self.rig.write(output_v(self.setup.calibration, decision.valve_v))
        finally:
            outcome = TickOutcome(
                applied_v,
                (sampled_ns - wake.now_ns) * 1e-9,
                (decided_ns - sampled_ns) * 1e-9,
                (now_ns() - decided_ns) * 1e-9,
            )
            self.journal.put_tick(
                TickRecord(
                    timing,
                    raw,
                    state.measurement,
                    reference,
                    state.estimate,
                    state.command,
                    decision,
                    outcome,
                    self.truth(),
                    state.compensated or (),
                )
            )
        # The last tick of each thousand, or the first one after it if that was missed.
        if (timing.tick + 1) % KEYFRAME_TICKS <= timing.missed:
            self.journal.put_keyframe(timing.tick, raw.encoder_t_ns, freeze_state(state))

    def _record_zero(self, tick: int, raw: RawSample, zero: Zero) -> None:
        """Record from which tick on the sensors have other zeros: replay needs it."""
        self.journal.put_event(tick, raw.encoder_t_ns, {"event": "zeroed", **zero._asdict()})

    def _end_tripped(self, timing: Timing, raw: RawSample, decision: Decision) -> Ending:
        self.rig.make_safe()
        reasons = explain_verdicts(decision.verdicts)
        event: dict[str, object] = {"event": "tripped", "reasons": reasons}
        self.journal.put_event(timing.tick, raw.encoder_t_ns, event)
        overruns_only = decision.verdicts == OVERRUNS
        code = ExitCode.OVERRUNS if overruns_only else ExitCode.SAFETY_TRIP
        return Ending(code, "safety trip: " + "; ".join(reasons))


def _make_timing(times: _Times, wake: Wake, raw: RawSample) -> Timing:
    return Timing(
        wake.tick,
        (raw.encoder_t_ns - times.first_t_ns) * 1e-9,
        (raw.encoder_t_ns - times.last_t_ns) * 1e-9,
        (wake.now_ns - wake.deadline_ns) * 1e-9,
        wake.missed,
    )
