"""The body of the loop: one kernel for the card, for simulations, and for logs.

    for k in range(n):
        timing, raw = sense(rig)               the card's sample, a simulated rig's, or a log's
        reference   = ask(guide)               given, of a course, or of a table
        state, decision = step(...)            `pamctl.realtime.tick`
        act(rig, decision)                     what a simulated rig does with the output
        rows[k] = ...                          the row of the ring

The type of `rig` chooses `sense` and `act`, in Python and in C. The loop calls it with n = 1 on the
card, `--fast` and batches with many ticks of a simulated rig, a replay with all ticks of a stretch.
As Python and as machine code it gives the same bits.
"""

from __future__ import annotations

import math
from functools import singledispatch
from typing import Any, NamedTuple

from hal.calibration import Output, nearest_output_v, output_v, quantise_v, valve_v
from hal.rig import RawSample
from hal.sim import SensorChain, sensed_counts, sensed_pressure_v
from pamctl.control.course import NO_COURSE, CoursePlace, find_course_reference
from pamctl.plant.parameters import PlantParameters, PlantState
from pamctl.plant.simulated import CommandLine, OnTheWay, advance_muscle, show_muscle
from pamctl.realtime.clock import Wake
from pamctl.realtime.tick import TickSetup, TickState, step
from pamctl.recording.rows import COMPENSATED_TICK, PLAIN_TICK, TickRow
from pamctl.signals import Decision, Reference, TickOutcome, TickRecord, Timing, Truth


class LoopState(NamedTuple):
    """What a tick leaves to the next one, and its own results."""

    state: TickState
    first_t_ns: int
    """Time of the encoder sample of the first tick."""
    place: CoursePlace
    """The segment of the course that the loop has come to."""
    timing: Timing
    raw: RawSample
    reference: Reference
    decision: Decision
    output_v: float
    """The voltage that the decision asks for."""


NOWHERE = Reference(0, math.nan, math.nan, math.nan, math.nan, math.nan)
"""No reference at all."""


def run_ticks(
    setup: TickSetup,
    loop: LoopState,
    rig: Any,
    inner: Any,
    outer: Any,
    guide: Guide,
    rows: Any,
    n: int,
) -> tuple[LoopState, Any, Any, int]:
    """Kernel: run at most n ticks; return the loop and the rig after them, and their number.

    It ends early behind the end of a course, and with a tick that safety tripped. `inner` is what
    the rig has come to, `outer` what it was told.
    """
    done = 0
    for k in range(n):
        sensed, timing, raw = sense(rig, inner, outer, loop, k)
        place, reference = ask(guide, loop.place, timing.t_s, k)
        if place.segments > 0 and place.segment == place.segments:
            break
        state, decision = step(setup, loop.state, raw, reference, timing)
        volts = output_v(setup.calibration, decision.valve_v)
        outer, outcome, truth, ends = act(rig, sensed, outer, decision, volts)
        rows[k] = TickRow(
            PLAIN_TICK if state.compensated is None else COMPENSATED_TICK,
            timing.tick,
            raw.encoder_t_ns,
            TickRecord(
                timing,
                raw,
                state.measurement,
                reference,
                state.estimate,
                state.command,
                decision,
                outcome,
                truth,
                state.compensated,
            ),
        )
        loop = LoopState(state, loop.first_t_ns, place, timing, raw, reference, decision, volts)
        inner, done = sensed, k + 1
        if ends:
            break
    return loop, inner, outer, done


def start_loop(state: TickState, first_t_ns: int, last_t_ns: int) -> LoopState:
    """Return the loop before a tick; the encoder's sample before it was taken at `last_t_ns`."""
    return LoopState(
        state,
        first_t_ns,
        NO_COURSE,
        Timing(0, 0.0, 0.0, 0.0, 0),
        RawSample(0.0, 0, last_t_ns, last_t_ns),
        NOWHERE,
        Decision(0.0, 0, False),
        math.nan,
    )


def make_timing(first_t_ns: int, last_t_ns: int, wake: Wake, raw: RawSample) -> Timing:
    """Return the time of a tick, after the first and the last encoder sample before it."""
    return Timing(
        wake.tick,
        (raw.encoder_t_ns - first_t_ns) * 1e-9,
        (raw.encoder_t_ns - last_t_ns) * 1e-9,
        (wake.now_ns - wake.deadline_ns) * 1e-9,
        wake.missed,
    )


@singledispatch
def sense(
    rig: Any, inner: Any, outer: Any, loop: LoopState, k: int
) -> tuple[Any, Timing, RawSample]:
    """Return the rig's state, the time, and the sample of tick `k`."""
    raise TypeError(f"{type(rig).__name__} is no rig for `run_ticks`")


@singledispatch
def act(
    rig: Any, inner: Any, outer: Any, decision: Decision, volts: float
) -> tuple[Any, TickOutcome, Truth, bool]:
    """Return what the rig was told, what is known of it, and whether the run ends."""
    raise TypeError(f"{type(rig).__name__} is no rig for `run_ticks`")


# --- a rig that others read and write: one tick a call -----------------------------------------


class Nothing(NamedTuple):
    """The state of a rig that has none here."""


class OpenRig(NamedTuple):
    """A rig that the loop itself reads and writes."""


class Sensed(NamedTuple):
    """What the loop has read."""

    wake: Wake
    raw: RawSample


@sense.register
def take_sample(
    rig: OpenRig, inner: Sensed, outer: Nothing, loop: LoopState, k: int
) -> tuple[Sensed, Timing, RawSample]:
    """Kernel: take the sample that was read."""
    timing = make_timing(loop.first_t_ns, loop.raw.encoder_t_ns, inner.wake, inner.raw)
    return inner, timing, inner.raw


@act.register
def leave_output(
    rig: OpenRig, inner: Sensed, outer: Nothing, decision: Decision, volts: float
) -> tuple[Nothing, TickOutcome, Truth, bool]:
    """Kernel: leave the output to the loop, which fills in what comes of it."""
    unknown = TickOutcome(math.nan, 0.0, 0.0, 0.0)
    return outer, unknown, Truth(math.nan, math.nan), decision.tripped


# --- a simulated rig without a clock -----------------------------------------------------------


class VirtualRig(NamedTuple):
    """What stays the same in a simulated rig."""

    plant: PlantParameters
    chain: SensorChain
    line: CommandLine
    period_ns: int
    output_delay_ticks: int
    longest_step_s: float
    deviates: Any
    """Standard normal deviates, shape (n,): the noise of the pressure sensor."""


class SimulatedState(NamedTuple):
    """What a simulated rig has come to."""

    tick: int
    """The number of the next tick."""
    plant_t_ns: int
    """The time that the plant has come to."""
    muscle: PlantState
    on_way: OnTheWay


class SimulatedOutput(NamedTuple):
    """What a simulated rig was told."""

    command_v: float
    """Valve command that acts on the plant."""
    output_v: float
    """Voltage on the analog output."""


@sense.register
def sample_simulated(
    rig: VirtualRig, inner: SimulatedState, outer: SimulatedOutput, loop: LoopState, k: int
) -> tuple[SimulatedState, Timing, RawSample]:
    """Kernel: let the plant catch up, and sample it, as `SimRig.read` does."""
    now_ns = inner.tick * rig.period_ns
    caught_up = catch_up(rig, inner, outer.command_v, now_ns)
    shown_m, shown_pa = show_muscle(rig.plant, caught_up.muscle)
    raw = RawSample(
        sensed_pressure_v(rig.chain, shown_pa, rig.deviates[k]),
        sensed_counts(rig.chain, shown_m),
        now_ns,
        now_ns,
    )
    wake = Wake(inner.tick, now_ns, now_ns, 0)
    return caught_up, make_timing(loop.first_t_ns, loop.raw.encoder_t_ns, wake, raw), raw


def catch_up(
    rig: VirtualRig, inner: SimulatedState, command_v: float, now_ns: int
) -> SimulatedState:
    """Kernel: advance the plant up to a time."""
    if now_ns <= inner.plant_t_ns:
        return SimulatedState(inner.tick + 1, inner.plant_t_ns, inner.muscle, inner.on_way)
    duration_s = (now_ns - inner.plant_t_ns) * 1e-9
    muscle, on_way = advance_muscle(
        rig.plant, rig.line, inner.muscle, inner.on_way, command_v, duration_s, rig.longest_step_s
    )
    return SimulatedState(inner.tick + 1, now_ns, muscle, on_way)


@act.register
def drive_simulated(
    rig: VirtualRig,
    inner: SimulatedState,
    outer: SimulatedOutput,
    decision: Decision,
    volts: float,
) -> tuple[SimulatedOutput, TickOutcome, Truth, bool]:
    """Kernel: apply the output, as `SimRig.write` does; a delayed one acts from the next read."""
    applied_v = quantise_v(rig.chain.output_converter, volts)
    acting_v = applied_v if rig.output_delay_ticks == 0 else outer.output_v
    return (
        SimulatedOutput(valve_v(rig.chain.calibration, acting_v), applied_v),
        TickOutcome(applied_v, 0.0, 0.0, 0.0),
        Truth(inner.muscle.position_m, inner.muscle.pressure_pa),
        decision.tripped,
    )


# --- a log -------------------------------------------------------------------------------------


class LoggedRig(NamedTuple):
    """The inputs of n ticks of a log, as columns of shape (n,), and the rig's output."""

    tick: Any
    t_s: Any
    dt_s: Any
    late_s: Any
    missed: Any
    pressure_v: Any
    encoder_counts: Any
    pressure_t_ns: Any
    encoder_t_ns: Any
    output: Output


@sense.register
def read_logged(
    rig: LoggedRig, inner: Nothing, outer: Nothing, loop: LoopState, k: int
) -> tuple[Nothing, Timing, RawSample]:
    """Kernel: read time and sample of a logged tick."""
    raw = RawSample(
        rig.pressure_v[k], rig.encoder_counts[k], rig.pressure_t_ns[k], rig.encoder_t_ns[k]
    )
    timing = Timing(rig.tick[k], rig.t_s[k], rig.dt_s[k], rig.late_s[k], rig.missed[k])
    return inner, timing, raw


@act.register
def find_logged_output(
    rig: LoggedRig, inner: Nothing, outer: Nothing, decision: Decision, volts: float
) -> tuple[Nothing, TickOutcome, Truth, bool]:
    """Kernel: return what the rig's output would have been. Nothing ends a log but its end."""
    outcome = TickOutcome(nearest_output_v(rig.output, volts), 0.0, 0.0, 0.0)
    return outer, outcome, Truth(math.nan, math.nan), False


# --- references --------------------------------------------------------------------------------


class Guide(NamedTuple):
    """Where the references come from: the course of `LoopState.place`, a table, or outside."""

    given: Reference
    """The reference of every tick where there is neither course nor table."""
    table: Any
    """The rows of a course, as `pamctl.control.course` packs them; or of each tick."""
    has_each_tick: bool
    """The table has the six numbers of a reference for each tick, one after the other."""


def ask(guide: Guide, place: CoursePlace, t_s: float, k: int) -> tuple[CoursePlace, Reference]:
    """Kernel: return the reference of tick `k`, and the place in the course."""
    table = guide.table
    if guide.has_each_tick:
        i = 6 * k
        return place, Reference(
            int(table[i]), table[i + 1], table[i + 2], table[i + 3], table[i + 4], table[i + 5]
        )
    if place.segments == 0:
        return place, guide.given
    return find_course_reference(place, table, t_s)
