"""The closed loop as one batch: `run_ticks` over a simulated rig, with a table of references.

A test compares it with the loop process tick by tick. Tuning and diagnosis run on it, and
`simulate_run` is a run of `pamctl run` on it, with its figures.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.calibration import output_v, quantise_v, valve_v
from hal.sim import SensorChain, SimSettings, sensor_chain
from pamctl.control.course import Course, Segment
from pamctl.control.experiment import plan_experiment
from pamctl.kernel.calls import recall
from pamctl.kernel.layout import Rows
from pamctl.offline.merit import Merit, compute_merit
from pamctl.plant.model import plant_parameters
from pamctl.plant.parameters import PlantParameters, vented_state
from pamctl.plant.simulated import LONGEST_STEP_S, OnTheWay, make_line
from pamctl.realtime.many_ticks import draw_deviates
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
from pamctl.realtime.tick_runner import UPDATES
from pamctl.recording.rows import TickRow, make_rows, row_dtype
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Reference, list_tick_fields

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_CHUNK = 2048
"""Ticks whose rows stay in the processor's cache until their columns are taken."""


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
class SimulatedRun:
    """A simulated run from the vented muscle, without homing; by name its columns."""

    reference: Floats
    rows: Floats
    """One for each tick, with the columns of `BatchRow`."""
    t_s: Floats
    """Time of each tick."""
    tripped_tick: int
    """Tick at which safety tripped and the run ended; -1 if it did not."""

    def __getitem__(self, column: str) -> Floats:
        """Return one column of `BatchRow`, or of `Reference`, by its name."""
        if column in BatchRow._fields:
            return self.rows[:, BatchRow._fields.index(column)]
        return self.reference[: len(self.rows), Reference._fields.index(column)]

    @property
    def tripped_s(self) -> float | None:
        """Time at which safety ended the run; None if it did not."""
        return None if self.tripped_tick < 0 else float(self.t_s[-1])

    @property
    def error_m(self) -> Floats:
        """Measured displacement minus reference; NaN in open loop."""
        return self["position_m"] - self["reference_m"]

    def merit(self) -> Merit | None:
        """Return the figures of merit; None if safety ended the run, or nothing was tracked."""
        if self.tripped_tick >= 0:
            return None
        return compute_merit(self.t_s, self["phase"].astype(np.int64), self.error_m)


def tabulate_references(
    segments: Sequence[Segment], period_s: float, duration_s: float | None = None
) -> Floats:
    """Tabulate an experiment, with one row a tick and the columns of `Reference`."""
    course = Course(segments, duration_s)
    period_ns = round(period_s * 1e9)  # the loop's clock counts whole nanoseconds
    rows: list[Reference] = []
    while (reference := course.at(len(rows) * period_ns * 1e-9)) is not None:
        rows.append(reference)
    return np.array(rows, dtype=np.float64).reshape(-1, len(Reference._fields))


def draw_sensor_noise(ticks: int, seed: int) -> Floats:
    """Draw the same noise as a simulated rig with this seed."""
    return np.array(draw_deviates(random.Random(seed), ticks))


def simulate(
    setup: TickSetup,
    plant: PlantParameters,
    chain: SensorChain,
    reference: Floats,
    noise: Floats,
    *,
    period_s: float = 1e-3,
    output_delay_ticks: int = 0,
    longest_step_s: float = LONGEST_STEP_S,
) -> SimulatedRun:
    """Run the closed loop on a table of references, from the vented muscle at rest.

    `reference` and `noise` have one row a tick. The run ends early if safety trips.
    """
    ticks, period_ns = len(reference), round(period_s * 1e9)
    rows = np.empty((ticks, len(BatchRow._fields)))
    references = np.ascontiguousarray(reference).ravel()
    buffer = make_rows(setup.compensation is not None, _CHUNK, None)
    zero = chain.zero._replace(encoder_zero_counts=math.floor(chain.zero[1]) + 0.0)
    output = quantise_v(
        chain.output_converter, output_v(setup.calibration, setup.limits.safe_valve_v)
    )
    rig = VirtualRig(
        plant, chain, make_line(plant, ticks), period_ns, output_delay_ticks, longest_step_s, noise
    )
    call = recall(
        run_ticks,
        {
            "setup": setup,
            "loop": start_loop(first_state(setup, zero), 0, -period_ns),
            "rig": rig,
            "inner": SimulatedState(0, 0, vented_state(plant), OnTheWay()),
            "outer": SimulatedOutput(valve_v(chain.calibration, output), output),
            "guide": Guide(NOWHERE, references[:0], True),
            "rows": buffer,
            "n": 0,
        },
        UPDATES,
    )
    done = 0
    while done < ticks:
        end = min(done + _CHUNK, ticks)
        call.put("rig", rig._replace(deviates=noise[done:end]))
        call.put("guide", Guide(NOWHERE, references[6 * done : 6 * end], True))
        call.put("n", end - done)
        call.run()
        ran: int = call.get("n")
        _keep_columns(buffer, rows[done : done + ran], setup.compensation is not None)
        done += ran
        if done < end:
            break
    is_tripped = done > 0 and bool(call.get("loop").decision.tripped)
    t_s = np.arange(done, dtype=np.float64) * period_s
    return SimulatedRun(reference, rows[:done], t_s, done - 1 if is_tripped else -1)


_KEPT = ("true_position_m", "true_pressure_pa", "", "", "error_m", "command_v", "valve_v")
"""The columns of the log that `BatchRow` has; empty where a compensation decides."""


def _keep_columns(buffer: Rows[TickRow], rows: Floats, compensates: bool) -> None:
    columns: Any = np.frombuffer(buffer.buffer, _find_dtype(compensates), len(rows))["columns"]
    for into, name in zip(rows.T, _KEPT, strict=True):
        if name:
            into[:] = columns[name]
    rows[:, 2] = columns["corrected_position_m" if compensates else "position_m"]
    rows[:, 3] = columns["corrected_pressure_pa" if compensates else "pressure_pa"]


@lru_cache
def _find_dtype(compensates: bool) -> np.dtype[Any]:
    return row_dtype(list_tick_fields(compensates), None)


def simulate_run(settings: RunSettings) -> SimulatedRun:
    """Simulate a run; raise ValueError if the rig is not a simulated one."""
    rig, sim = settings.rig, settings.rig.device_settings
    if not isinstance(sim, SimSettings):
        raise ValueError("only a simulated rig can be run as a batch")
    period_s = 1.0 / rig.loop.rate_hz
    table = _tabulate(plan_experiment(settings.experiment).segments, period_s, settings.duration_s)
    return simulate(
        build_tick_setup(settings),
        plant_parameters(settings.plant),
        sensor_chain(sim, rig.calibration),
        table,
        _draw_noise(len(table), settings.seed),
        period_s=period_s,
        output_delay_ticks=sim.output_delay_ticks,
    )


# Both are computed in plain Python, which takes longer than a run, so runs share them.
@lru_cache(maxsize=8)
def _tabulate(course: tuple[Segment, ...], period_s: float, duration_s: float | None) -> Floats:
    return tabulate_references(course, period_s, duration_s)


@lru_cache(maxsize=8)
def _draw_noise(ticks: int, seed: int) -> Floats:
    return draw_sensor_noise(ticks, seed)
