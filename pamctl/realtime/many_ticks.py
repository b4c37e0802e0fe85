"""Many ticks at once, for runs without a clock: `run_ticks` over the simulated rig.

It goes on until something needs the loop: the end of the course, a cue, a frozen state, a trip. The
rows are those of the loop, to the bit.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from random import Random
from typing import Any

from hal.rig import RawSample
from hal.sim import SimMoment, SimRig
from pamctl.kernel.calls import machine, prepare
from pamctl.kernel.layout import Block
from pamctl.plant.simulated import LONGEST_STEP_S, SimulatedPlant
from pamctl.realtime.clock import Clock, VirtualClock
from pamctl.realtime.run_ticks import (
    NOWHERE,
    Guide,
    SimulatedOutput,
    SimulatedState,
    VirtualRig,
    run_ticks,
    start_loop,
)
from pamctl.realtime.tick import TickSetup, first_state
from pamctl.realtime.tick_runner import UPDATES, TickRunner
from pamctl.recording.journal import RingJournal
from pamctl.recording.rows import ROW_BYTES, make_rows

MOST_TICKS = 1000


def draw_deviates(random: Random, n: int) -> array[float]:
    """Draw n standard normal deviates, those of n calls of `random.gauss(0.0, 1.0)` to the bit."""
    left: float | None = random.gauss_next  # type: ignore[attr-defined]
    deviates = array("d", () if left is None else (0.0 + left,))
    missing = n - len(deviates)
    if missing > 0:
        uniforms = array("d", [random.random() for _ in range(missing + missing % 2)])
        machine(fill_deviates)(uniforms)
        deviates += uniforms
    random.gauss_next = deviates.pop() if len(deviates) > n else None  # type: ignore[attr-defined]
    return deviates


def fill_deviates(numbers: Any) -> None:
    """Kernel: make uniform numbers normal, pair by pair, as Python's `Random.gauss` does."""
    for k in range(len(numbers) // 2):
        angle = numbers[2 * k] * (2.0 * math.pi)
        radius = math.sqrt(-2.0 * math.log(1.0 - numbers[2 * k + 1]))
        numbers[2 * k] = 0.0 + math.cos(angle) * radius
        numbers[2 * k + 1] = 0.0 + math.sin(angle) * radius


def find_many_ticks(setup: TickSetup, rig: Any, clock: Clock) -> SimulatedTicks | None:
    """Return what runs many ticks of a rig; None for a rig with its own time, or with faults."""
    if not (isinstance(rig, SimRig) and isinstance(clock, VirtualClock)):
        return None
    return SimulatedTicks(setup, rig, clock) if isinstance(rig.parts[0], SimulatedPlant) else None


class SimulatedTicks:
    """Runs many ticks of a loop at once, on its simulated rig."""

    def __init__(self, setup: TickSetup, rig: SimRig, clock: VirtualClock) -> None:
        """Build the machine code if it is missing. Raise `NotInC` for a law that is no kernel."""
        plant, self._chain, self._delay_ticks, self._random = rig.parts
        assert isinstance(plant, SimulatedPlant)
        self._rig, self._plant, self._clock = rig, plant, clock
        self._rows = make_rows(setup.compensation is not None, MOST_TICKS)
        self._raw: Block[RawSample] = self._rows.block.find_part("record.raw")
        start = first_state(setup, self._chain.zero)
        table = array("d", (0.0,))
        self._call = prepare(
            run_ticks,
            {
                "setup": setup,
                "loop": start_loop(start, 0, 0),
                "rig": self._describe_rig(table),
                "inner": SimulatedState(0, 0, plant.state, plant.on_way),
                "outer": SimulatedOutput(0.0, 0.0),
                "guide": Guide(NOWHERE, table, False),
                "rows": self._rows,
                "n": 0,
            },
            UPDATES,
        )

    def _describe_rig(self, deviates: array[float]) -> VirtualRig:
        plant = self._plant
        return VirtualRig(
            plant.parameters,
            self._chain,
            plant.line,
            self._clock.period_ns,
            self._delay_ticks,
            LONGEST_STEP_S,
            deviates,
        )

    def run(self, tick: TickRunner, first_tick: int, ticks: int, journal: RingJournal) -> int:
        """Run at most so many ticks and put their rows; return how many there were.

        `tick` must follow a course, or goes on with the reference of its last tick. It is in the
        state after the last of these ticks.
        """
        call, random = self._call, self._random
        ticks = min(ticks, MOST_TICKS)
        if ticks <= 0 or not call.fits("setup", tick.setup):
            return 0
        before, deviates = random.getstate(), draw_deviates(random, ticks)
        self._plant.give_room(ticks)
        call.put("setup", tick.setup)
        call.put("loop", tick.loop)
        call.put("rig", self._describe_rig(deviates))
        plant, moment = self._plant, self._rig.freeze()
        state = SimulatedState(first_tick, moment.plant_t_ns, plant.state, plant.on_way)
        call.put("inner", state)
        call.put("outer", SimulatedOutput(moment.command_v, moment.output_v))
        call.put("guide", tick.guide)
        call.put("n", ticks)
        try:
            call.run()
        except (ArithmeticError, ValueError):
            random.setstate(before)
            return 0  # the loop runs each tick alone, and says which one fails
        done: int = call.get("n")
        if done < ticks:
            random.setstate(before)
            draw_deviates(random, done)
        if done:
            after: SimulatedState = call.get("inner")
            plant.put(after.muscle, after.on_way)
            output: SimulatedOutput = call.get("outer")
            self._rig.thaw(SimMoment(output.command_v, output.output_v, after.plant_t_ns))
            tick.take_over(call.get("loop"))
            self._clock.skip_to(first_tick + done - 1)
            journal.put_rows(memoryview(self._rows.buffer)[: done * ROW_BYTES])
        return done

    def samples(self, ticks: int) -> Iterator[RawSample]:
        """Yield the samples of the ticks that were run last."""
        rows = memoryview(self._rows.buffer)
        return (self._raw.read(rows[k * ROW_BYTES :]) for k in range(ticks))
