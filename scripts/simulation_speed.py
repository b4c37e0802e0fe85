"""One timed pass over plant, laws and tick: what `bench.py --only plant,laws` asks for.

Times are processor times, without the garbage collector, as in the loop process.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.rig import RawSample
from hal.sim import sensed_counts, sensed_pressure_v, sensor_chain
from pamctl.control.experiment import plan_experiment
from pamctl.control.law import Memory, respond
from pamctl.kernel.calls import machine
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import PlantParameters, PlantState, vented_state
from pamctl.plant.step import advance_plant
from pamctl.realtime.tick import TickState, first_state, step
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import resolve
from pamctl.signals import Estimate, Reference, Timing
from pamctl.simulate.closed_loop import draw_sensor_noise, simulate, tabulate_references

TICK_S = 1e-3
LAWS = ("qsmc", "smc", "pid")
STEPS = (1, 2, 4)
P = plant_parameters(PlantSettings())
SQUARE_V = [5.0 if i % 1000 < 500 else -5.0 for i in range(2000)]
SMALL_V = [
    0.0 if i // 250 % 4 == 3 else 1.5 * math.sin(2 * math.pi * 3 * i * TICK_S) for i in range(2000)
]
LAW_TICKS = 5000
Figures = dict[str, float]


def time_work(work: Callable[[], object]) -> float:
    """Return the processor seconds of a call that was made once before: code is compiled."""
    work()
    gc.collect()
    gc.disable()
    begin_s = time.process_time()
    work()
    taken_s = time.process_time() - begin_s
    gc.enable()
    return taken_s


# --- the plant -----------------------------------------------------------------------------------


def run_plant(
    p: PlantParameters,
    state: PlantState,
    commands_v: NDArray[np.float64],
    longest_step_s: float,
    positions_m: NDArray[np.float64],
) -> None:
    """Kernel: hold each command for a tick."""
    for i in range(len(commands_v)):
        state = advance_plant(p, state, commands_v[i], 1e-3, longest_step_s)
        positions_m[i] = state.position_m


def run_plant_compiled(commands_v: Sequence[float], steps: int) -> NDArray[np.float64]:
    commands = np.array(commands_v)
    positions_m = np.empty_like(commands)
    machine(run_plant)(P, vented_state(P), commands, TICK_S / steps, positions_m)
    return positions_m


def run_plant_plain(commands_v: Sequence[float], steps: int) -> None:
    state = vented_state(P)
    for command_v in commands_v:
        state = advance_plant(P, state, command_v, TICK_S, TICK_S / steps)


def largest_um(positions_m: Any, converged_m: NDArray[np.float64]) -> float:
    difference_m = np.abs(np.asarray(positions_m) - converged_m[: len(positions_m)])
    return float(difference_m.max() * 1e6)


def time_plant() -> dict[str, Figures]:
    """Time a tick of the plant and of LSODA, each with its distance from 512 steps a tick."""
    converged_m = run_plant_compiled(SQUARE_V, 512)
    small_m = run_plant_compiled(SMALL_V, 512)
    found: dict[str, Figures] = {}
    for steps in STEPS:
        errors = {
            "square_error_um": largest_um(run_plant_compiled(SQUARE_V, steps), converged_m),
            "small_error_um": largest_um(run_plant_compiled(SMALL_V, steps), small_m),
        }
        runs: dict[str, Callable[[], object]] = {
            "compiled": lambda steps=steps: run_plant_compiled(SQUARE_V * 5, steps),
            "plain": lambda steps=steps: run_plant_plain(SQUARE_V, steps),
        }
        for form, run in runs.items():
            ticks = len(SQUARE_V) * (5 if form == "compiled" else 1)
            tick_us = time_work(run) / ticks * 1e6
            speeds = {"tick_us": tick_us, "times_real_time": 1e3 / tick_us}
            found[f"{form}, {steps} steps"] = speeds | errors
    return found


# --- the closed loop -----------------------------------------------------------------------------


class ClosedLoop:
    """A law with its shipped gains on experiment 2, and its inputs."""

    def __init__(self, law: str) -> None:
        settings = resolve(controller=law, overrides=["rig.homing.enabled=false"], fast=True)
        rig: Any = settings.rig
        self.setup = build_tick_setup(settings)
        self.chain = sensor_chain(rig.sim, rig.calibration)
        self.reference = tabulate_references(plan_experiment(settings.experiment).segments, TICK_S)
        self.noise = draw_sensor_noise(len(self.reference), 0)
        self.batch = self.simulate()

    def simulate(self) -> Any:
        """Run the whole experiment."""
        return simulate(self.setup, P, self.chain, self.reference, self.noise)

    def ticks(self, count: int) -> list[tuple[RawSample, Reference, Timing]]:
        """Return the inputs of the tick, from the middle of the approach on."""
        xs, pressures = self.batch["true_position_m"], self.batch["true_pressure_pa"]
        return [
            (
                RawSample(
                    sensed_pressure_v(self.chain, float(pressures[i]), float(self.noise[i])),
                    sensed_counts(self.chain, float(xs[i])),
                    i * 1_000_000,
                    i * 1_000_000,
                ),
                Reference(int(self.reference[i, 0]), *map(float, self.reference[i, 1:])),
                Timing(i, i * TICK_S, TICK_S, 0.0, 0),
            )
            for i in range(2000, 2000 + count)
        ]

    def start(self) -> TickState:
        """Return the state before the first tick, homed."""
        return first_state(self.setup, self.chain.zero._replace(encoder_zero_counts=1000.0))

    def estimates(self, count: int) -> list[tuple[Reference, Estimate]]:
        """Return the inputs of the law."""
        state, seen = self.start(), []
        for raw, reference, timing in self.ticks(count):
            state, _ = step(self.setup, state, raw, reference, timing)
            seen.append((reference, state.estimate))
        return seen


def run_law(loop: ClosedLoop, seen: Sequence[tuple[Reference, Estimate]]) -> Memory:
    gains, armed = loop.setup.gains, loop.setup.armed
    state = armed
    for reference, estimate in seen:
        _, state = respond(gains, armed, state, reference, estimate, TICK_S)
    return state


def run_nothing(seen: Sequence[tuple[Reference, Estimate]]) -> None:
    """Run the same loop without the call."""
    gains, state = None, None
    for _reference, _estimate in seen:
        _, state = gains, state


def time_steps(loops: dict[str, ClosedLoop]) -> dict[str, float]:
    """Return the time of one step of each law, in plain Python, us."""
    found = {}
    for law, loop in loops.items():
        seen = loop.estimates(LAW_TICKS)
        taken_s = time_work(lambda loop=loop, seen=seen: run_law(loop, seen))
        idle_s = time_work(lambda seen=seen: run_nothing(seen))
        found[law] = (taken_s - idle_s) / LAW_TICKS * 1e6
    return found


def time_ticks(loop: ClosedLoop) -> NDArray[np.float64]:
    """Return the time of each tick in plain Python, without the readings of the clock, us."""
    setup, state, now_ns = loop.setup, loop.start(), time.perf_counter_ns
    taken_ns = []
    for raw, reference, timing in loop.ticks(LAW_TICKS):
        begin_ns = now_ns()
        state, _ = step(setup, state, raw, reference, timing)
        taken_ns.append(now_ns() - begin_ns)
    clock_ns = float(np.median([-now_ns() + now_ns() for _ in range(1000)]))
    return (np.array(taken_ns) - clock_ns) / 1e3


def time_laws() -> dict[str, Figures]:
    """Time the compiled closed loop, a step of the law, and a tick in plain Python."""
    loops = {law: ClosedLoop(law) for law in LAWS}
    steps_us = time_steps(loops)
    found: dict[str, Figures] = {}
    for law, loop in loops.items():
        loop_us = time_work(loop.simulate) / len(loop.reference) * 1e6
        p50_us, p99_us = np.percentile(time_ticks(loop), (50, 99)).tolist()
        found[law] = {
            "closed_loop_times_real_time": 1e3 / loop_us,
            "step_us": steps_us[law],
            "tick_p50_us": p50_us,
            "tick_p99_us": p99_us,
        }
    return found
