"""Simulate a run of `pamctl run` on the compiled closed loop, and compute its figures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hal.sim.sim_rig import SimSettings, sensor_chain
from pamctl.control.course import Segment
from pamctl.control.experiment import plan_experiment
from pamctl.plant.model import plant_parameters
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import RunSettings
from pamctl.simulate.closed_loop import BatchRun, draw_sensor_noise, simulate, tabulate_references
from pamctl.simulate.merit import Merit, compute_merit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SimulatedRun:
    """A simulated run from the vented muscle, without homing."""

    settings: RunSettings
    run: BatchRun
    t_s: Floats
    """Time of each tick, as long as the columns of the run."""

    def __getitem__(self, column: str) -> Floats:
        """Return a column of `pamctl.simulate.closed_loop.BatchRow`, or of `Reference`."""
        return self.run[column]

    @property
    def tripped_s(self) -> float | None:
        """Time at which safety ended the run; None if it did not."""
        return None if self.run.tripped_tick < 0 else float(self.t_s[-1])

    @property
    def error_m(self) -> Floats:
        """Measured displacement minus reference; NaN in open loop."""
        return self.run["position_m"] - self.run["reference_m"]

    def merit(self) -> Merit | None:
        """Return the figures of merit; None if safety ended the run, or nothing was tracked."""
        if self.run.tripped_tick >= 0:
            return None
        return compute_merit(self.t_s, self.run["phase"].astype(np.int64), self.error_m)


def simulate_run(settings: RunSettings) -> SimulatedRun:
    """Simulate a run; raise ValueError if the rig is not a simulated one."""
    rig, sim = settings.rig, settings.rig.device_settings
    if not isinstance(sim, SimSettings):
        raise ValueError("only a simulated rig can be run as a batch")
    period_s = 1.0 / rig.loop.rate_hz
    table = _tabulate(plan_experiment(settings.experiment).segments, period_s, settings.duration_s)
    run = simulate(
        build_tick_setup(settings),
        plant_parameters(settings.plant),
        sensor_chain(sim, rig.calibration),
        table,
        _draw_noise(len(table), settings.seed),
        period_s=period_s,
        output_delay_ticks=sim.output_delay_ticks,
    )
    return SimulatedRun(settings, run, np.arange(len(run.rows), dtype=np.float64) * period_s)


# Both are computed in plain Python, which takes longer than a run, so runs share them.
@lru_cache(maxsize=8)
def _tabulate(course: tuple[Segment, ...], period_s: float, duration_s: float | None) -> Floats:
    return tabulate_references(course, period_s, duration_s)


@lru_cache(maxsize=8)
def _draw_noise(ticks: int, seed: int) -> Floats:
    return draw_sensor_noise(ticks, seed)
