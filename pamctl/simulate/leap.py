"""Many ticks at once: the closed loop over the simulated rig, from row to row of the ring.

For runs without a clock. Machine code runs plant, sensors, tick and valve until something needs
Python: the end of the course, a cue, a frozen state, a trip. The rows are those of the loop, to the
bit: it calls the same kernels in the order of `SimRig` and the loop.
"""

from __future__ import annotations

import math
from array import array
from textwrap import indent
from typing import TYPE_CHECKING, Any, NamedTuple

from hal.calibration import valve_v
from hal.converter import quantise_v
from hal.rig import RawSample
from hal.sim.sim_rig import (
    SensorChain,
    SimMoment,
    SimRig,
    sensed_counts,
    sensed_pressure_v,
)
from pamctl.compiled_ahead.layout import WORD_BYTES, Block, construct, store
from pamctl.compiled_ahead.library import KernelLibrary
from pamctl.control.course_table import CoursePlace
from pamctl.plant.parameters import PlantParameters, PlantState
from pamctl.plant.sensing import sensed_position_m, sensed_pressure_pa
from pamctl.plant.simulated import LONGEST_STEP_S, SimulatedPlant
from pamctl.plant.step import advance_plant
from pamctl.realtime.clock import VirtualClock, Wake
from pamctl.realtime.tick import TickSetup, TickState
from pamctl.realtime.tick_path import CompiledTick
from pamctl.realtime.tick_words import Sensed, TickWords, write_row
from pamctl.realtime.whole_tick import TickTimes, WholeTick, run_whole_tick
from pamctl.recording.ring import ROW_BYTES
from pamctl.signals import Reference, TickOutcome, Truth

if TYPE_CHECKING:
    from pamctl.realtime.loop import RowsJournal

MOST_TICKS = 1000


class GaussState(NamedTuple):
    """The state of Python's `Random.gauss` beside its uniform numbers."""

    next_deviate: float
    """The second of a pair; NaN if there is none."""
    drawn: int
    """Uniform numbers used so far in this leap."""


class LeapSpan(NamedTuple):
    """How far to leap."""

    ticks: int
    """At most so many."""
    first_tick: int
    period_ns: int
    output_delay_ticks: int
    done: int
    """Ticks that were run."""


class SimulatedTick(NamedTuple):
    """The results of a tick over the simulated rig."""

    done: WholeTick
    sensed: Sensed
    muscle: PlantState
    moment: SimMoment
    noise: GaussState
    outcome: TickOutcome
    truth: Truth


def run_simulated_tick(
    setup: TickSetup,
    state: TickState,
    times: TickTimes,
    place: CoursePlace,
    given: Reference,
    table: Any,
    plant: PlantParameters,
    muscle: PlantState,
    chain: SensorChain,
    moment: SimMoment,
    noise: GaussState,
    uniforms: Any,
    span: LeapSpan,
    tick: int,
) -> SimulatedTick:
    """Kernel: read, tick and write once."""
    now_ns = tick * span.period_ns
    if now_ns > moment.plant_t_ns:
        duration_s = (now_ns - moment.plant_t_ns) * 1e-9
        muscle = advance_plant(plant, muscle, moment.command_v, duration_s, LONGEST_STEP_S)
    command_v = valve_v(chain.calibration, moment.output_v)
    deviate, noise = draw_deviate(noise, uniforms)
    shown_pa = sensed_pressure_pa(
        plant, muscle.pressure_pa, muscle.air, muscle.sensors, muscle.age_s
    )
    shown_m = sensed_position_m(plant, muscle.position_m, muscle.sensors, muscle.age_s)
    raw = RawSample(
        sensed_pressure_v(chain, shown_pa, deviate), sensed_counts(chain, shown_m), now_ns, now_ns
    )
    wake = Wake(tick, now_ns, now_ns, 0)
    done = run_whole_tick(setup, state, times, place, wake, raw, given, table)
    volts = quantise_v(chain.output_converter, done.output_v)
    if span.output_delay_ticks == 0:
        command_v = valve_v(chain.calibration, volts)
    return SimulatedTick(
        done,
        Sensed(wake, raw),
        muscle,
        SimMoment(command_v, volts, now_ns),
        noise,
        TickOutcome(volts, 0.0, 0.0, 0.0),
        Truth(muscle.position_m, muscle.pressure_pa),
    )


def draw_deviate(noise: GaussState, uniforms: Any) -> tuple[float, GaussState]:
    """Kernel: return a standard normal deviate, as Python's `Random.gauss` does."""
    if not math.isnan(noise.next_deviate):
        return 0.0 + noise.next_deviate * 1.0, GaussState(math.nan, noise.drawn)
    angle = uniforms[noise.drawn] * (2.0 * math.pi)
    radius = math.sqrt(-2.0 * math.log(1.0 - uniforms[noise.drawn + 1]))
    return 0.0 + math.cos(angle) * radius * 1.0, GaussState(
        math.sin(angle) * radius, noise.drawn + 2
    )


def may_leap(rig: SimRig) -> bool:
    """Tell whether machine code can run the plant of a rig: one without commands on their way."""
    plant = rig.parts[0]
    return isinstance(plant, SimulatedPlant) and not plant.is_delayed


class LeapWords(TickWords):
    """Where everything lies: the words of the tick first, then those of the simulation."""

    def __init__(self, setup: TickSetup, rig: SimRig) -> None:
        """Lay out for set-ups and rigs like these. Raises `NotFlat`."""
        super().__init__(setup)
        plant, chain, _, _ = rig.parts
        assert isinstance(plant, SimulatedPlant)
        self.plant: Block[PlantParameters] = Block(plant.parameters, self.answered.end)
        self.muscle: Block[PlantState] = Block(plant.state, self.plant.end)
        self.chain: Block[SensorChain] = Block(chain, self.muscle.end)
        self.moment: Block[SimMoment] = Block(SimMoment(0.0, 0.0, 0), self.chain.end)
        self.noise: Block[GaussState] = Block(GaussState(0.0, 0), self.moment.end)
        self.span: Block[LeapSpan] = Block(LeapSpan(0, 0, 0, 0, 0), self.noise.end)
        self.words = self.span.end

    def write_leap(self) -> tuple[str, dict[str, Any]]:
        """Return the source of the function between words and kernel, and the types it names."""
        types: dict[type, str] = {}
        rig = ("plant", "muscle", "chain", "moment", "noise", "span")
        done_at = self.span.begin + LeapSpan._fields.index("done")
        begin = [
            *self.write_arguments(types),
            *(f"{name} = {construct(getattr(self, name), types)}" for name in rig),
            f"ints[{done_at}] = 0",
            "for at in range(span.ticks):",
        ]
        each = [
            "ticked = kernel(setup, state, times, place, given, table, plant, muscle, chain,"
            " moment, noise, uniforms, span, span.first_tick + at)",
            "done = ticked.done",
            "if not done.is_done:",
            "    return",
            "state, times, place = done.state, done.times, done.place",
            "muscle, moment, noise = ticked.muscle, ticked.moment, ticked.noise",
            "base = at * 512",
            *write_row(
                self.fields,
                {"raw": "ticked.sensed.raw", "outcome": "ticked.outcome", "truth": "ticked.truth"},
                "base + ",
            ),
            *self.write_results(),
            *store(self.sensed, "ticked.sensed."),
            *store(self.muscle, "muscle."),
            *store(self.moment, "moment."),
            *store(self.noise, "noise."),
            f"ints[{done_at}] = at + 1",
            "if done.decision.tripped:",
            "    return",
        ]
        body = indent("\n".join(begin) + "\n" + indent("\n".join(each), "    "), "    ")
        source = f"def glue(ints, floats, row, table, uniforms):\n{body}\n"
        return source, {name: kind for kind, name in types.items()}


assert ROW_BYTES == 512, "`write_leap` has it as a number"


class Leap:
    """Runs many ticks of a loop at once, on the words of its tick."""

    def __init__(
        self, library: KernelLibrary, words: LeapWords, rig: SimRig, clock: VirtualClock
    ) -> None:
        """Use a library that was built from these words."""
        self._library = library
        self._layout, self._rig, self._clock = words, rig, clock
        self._rows = bytearray(MOST_TICKS * ROW_BYTES)
        self._uniforms = bytearray((MOST_TICKS + 2) * WORD_BYTES)
        plant, self._chain, self._delay_ticks, self._random = rig.parts
        assert isinstance(plant, SimulatedPlant)
        self._plant = plant
        self._bound: tuple[Any, list[Any]] | None = None

    def run(self, tick: CompiledTick, first_tick: int, ticks: int, journal: RowsJournal) -> int:
        """Run at most so many ticks and put their rows; return how many there were.

        `tick` must follow a course. It is in the state after the last of these ticks.
        """
        ticks = min(ticks, MOST_TICKS)
        words, layout, random = tick.words, self._layout, self._random
        function, arguments = self._bind(tick)
        before = random.getstate()
        following: float | None = random.gauss_next  # type: ignore[attr-defined]
        drawn = self._draw_uniforms(ticks - (following is not None))
        layout.muscle.write(words, self._plant.state)
        layout.moment.write(words, self._rig.freeze())
        layout.noise.write(words, GaussState(math.nan if following is None else following, 0))
        span = LeapSpan(ticks, first_tick, self._clock.period_ns, self._delay_ticks, 0)
        layout.span.write(words, span)
        function(*arguments)  # where it fails, the ticks before are done, and Python says why
        done, noise = layout.span.read(words).done, layout.noise.read(words)
        if noise.drawn < drawn:
            random.setstate(before)
            for _ in range(noise.drawn):
                random.random()
        after = noise.next_deviate
        random.gauss_next = None if math.isnan(after) else after  # type: ignore[attr-defined]
        self._plant.state = layout.muscle.read(words)
        self._rig.thaw(layout.moment.read(words))
        if done:
            self._clock.skip_to(first_tick + done - 1)
            journal.put_rows(memoryview(self._rows)[: done * ROW_BYTES])
        return done

    def _bind(self, tick: CompiledTick) -> tuple[Any, list[Any]]:
        if self._bound is None:
            words, layout = tick.words, self._layout
            self._bound = self._library.bind(words, words, self._rows, tick.table, self._uniforms)
            layout.plant.write(words, self._plant.parameters)
            layout.chain.write(words, self._chain)
        return self._bound

    def _draw_uniforms(self, deviates: int) -> int:
        """Draw what so many deviates need, two for each pair; return how many these are."""
        draw, count = self._random.random, (deviates + 1) // 2 * 2
        numbers = array("d", [draw() for _ in range(count)])
        self._uniforms[: count * WORD_BYTES] = numbers.tobytes()
        return count
