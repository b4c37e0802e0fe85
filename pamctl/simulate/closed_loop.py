"""The closed loop in one compiled batch: plant, sensors, tick, valve.

It calls the same kernels as the loop process and the simulated rig, in the same order; a test
compares the two tick by tick. Tuning and diagnosis run on it.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hal.calibration import output_v, valve_v
from hal.converter import quantise_v
from hal.rig import RawSample
from hal.sim.sim_rig import SensorChain, sensed_counts, sensed_pressure_v
from pamctl.compensation.around_the_law import correct_measurement
from pamctl.compiled import compile_kernel
from pamctl.control.course import Course, Segment
from pamctl.control.law import KERNELS, LawKernel, answer
from pamctl.plant.delayed_command import advance_delayed_plant
from pamctl.plant.parameters import PlantParameters, PlantState, vented_state
from pamctl.plant.sensing import sensed_position_m, sensed_pressure_pa
from pamctl.plant.simulated import LONGEST_STEP_S
from pamctl.plant.step import advance_plant
from pamctl.realtime.tick import TickSetup, TickState, first_state, step
from pamctl.signals import Reference, Timing

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray


class BatchRow(NamedTuple):
    """The values that the batch keeps of each tick."""

    true_position_m: float
    true_pressure_pa: float
    position_m: float
    """As measured, and corrected by a compensation where there is one; so is the pressure."""
    pressure_pa: float
    error_m: float
    command_v: float
    valve_v: float


@dataclass(frozen=True)
class BatchRun:
    """One batch simulation: columns of `BatchRow`, each as long as `reference`."""

    reference: NDArray[np.float64]
    rows: NDArray[np.float64]
    tripped_tick: int
    """Tick at which safety tripped and the simulation ended; -1 if it did not."""

    def __getitem__(self, column: str) -> NDArray[np.float64]:
        """Return one column of `BatchRow`, or of `Reference`, by its name."""
        if column in BatchRow._fields:
            return self.rows[:, BatchRow._fields.index(column)]
        return self.reference[: len(self.rows), Reference._fields.index(column)]


def tabulate_references(
    segments: Sequence[Segment], period_s: float, duration_s: float | None = None
) -> NDArray[np.float64]:
    """Tabulate an experiment, with one row a tick and the columns of `Reference`."""
    course = Course(segments, duration_s)
    period_ns = round(period_s * 1e9)  # the loop's clock counts whole nanoseconds
    rows: list[Reference] = []
    while (reference := course.at(len(rows) * period_ns * 1e-9)) is not None:
        rows.append(reference)
    return np.array(rows, dtype=np.float64).reshape(-1, len(Reference._fields))


def draw_sensor_noise(ticks: int, seed: int) -> NDArray[np.float64]:
    """Draw the same noise as a simulated rig with this seed."""
    gauss = random.Random(seed).gauss
    return np.array([gauss(0.0, 1.0) for _ in range(ticks)])


def simulate(
    setup: TickSetup,
    plant: PlantParameters,
    chain: SensorChain,
    reference: NDArray[np.float64],
    noise: NDArray[np.float64],
    *,
    period_s: float = 1e-3,
    output_delay_ticks: int = 0,
    longest_step_s: float = LONGEST_STEP_S,
) -> BatchRun:
    """Run the closed loop on a table of references, from the vented muscle at rest.

    `reference` and `noise` have one row a tick. The run ends early if safety trips.
    """
    rows = np.full((len(reference), len(BatchRow._fields)), math.nan)
    start = vented_state(plant)
    ticks = _compile_closed_loop(KERNELS[type(setup.gains)])(
        setup,
        first_state(
            setup, chain.zero._replace(encoder_zero_counts=math.floor(chain.zero[1]) + 0.0)
        ),
        plant,
        start,
        chain,
        reference,
        noise,
        round(period_s * 1e9) * 1e-9,
        output_delay_ticks,
        longest_step_s,
        rows,
    )
    tripped = ticks if ticks < len(reference) else -1
    return BatchRun(reference, rows[: ticks + 1], tripped)


@cache
def _compile_closed_loop(law: LawKernel) -> Callable[..., int]:
    return compile_kernel(run_closed_loop, (answer, law))


def run_closed_loop(
    setup: TickSetup,
    state: TickState,
    plant: PlantParameters,
    muscle: PlantState,
    chain: SensorChain,
    references: NDArray[np.float64],
    noise: NDArray[np.float64],
    period_s: float,
    output_delay_ticks: int,
    longest_step_s: float,
    rows: NDArray[np.float64],
) -> int:
    """Kernel: fill `rows` tick by tick; return the tick that tripped, or the number of ticks."""
    output = quantise_v(
        chain.output_converter, output_v(setup.calibration, setup.limits.safe_valve_v)
    )
    written = valve = valve_v(chain.calibration, output)
    late = plant.effects.timing.command_delay.delay_s > 0.0
    written_s, written_v = np.zeros(len(references)), np.zeros(len(references))
    arrived, now_s = 0, 0.0
    for tick in range(len(references)):
        if tick and late:
            written_s[tick - 1] = now_s
            written_v[tick - 1] = valve
            muscle, arrived = advance_delayed_plant(
                plant,
                muscle,
                written_s,
                written_v,
                tick,
                arrived,
                now_s,
                period_s,
                longest_step_s,
            )
            now_s += period_s
        elif tick:
            muscle = advance_plant(plant, muscle, valve, period_s, longest_step_s)
        t_ns = 0
        raw = RawSample(
            sensed_pressure_v(
                chain,
                sensed_pressure_pa(
                    plant, muscle.pressure_pa, muscle.air, muscle.sensors, muscle.age_s
                ),
                noise[tick],
            ),
            sensed_counts(
                chain, sensed_position_m(plant, muscle.position_m, muscle.sensors, muscle.age_s)
            ),
            t_ns,
            t_ns,
        )
        row = references[tick]
        reference = Reference(int(row[0]), row[1], row[2], row[3], row[4], row[5])
        timing = Timing(tick, tick * period_s, period_s, 0.0, 0)
        state, decision = step(setup, state, raw, reference, timing)
        rows[tick, 0] = muscle.position_m
        rows[tick, 1] = muscle.pressure_pa
        rows[tick, 2], rows[tick, 3] = correct_measurement(setup.compensation, state.measurement)
        rows[tick, 4] = state.estimate.error_m
        rows[tick, 5] = state.command.command_v
        rows[tick, 6] = decision.valve_v
        if decision.tripped:
            return tick
        if output_delay_ticks:
            valve = written
        output = quantise_v(chain.output_converter, output_v(setup.calibration, decision.valve_v))
        written = valve_v(chain.calibration, output)
        if not output_delay_ticks:
            valve = written
    return len(references)
