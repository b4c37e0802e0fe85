"""A run as a batch: the settings of `pamctl run` on the compiled closed loop, and its figures."""

from __future__ import annotations

import numpy as np

from hal.sim import sensor_chain
from pamctl.cli.assembly import setup_of
from pamctl.closed_loop import references, sensor_noise, simulate
from pamctl.control.experiment import segments
from pamctl.merit import Merit, merit
from pamctl.plant.model import plant_parameters
from pamctl.rig_settings import SimRigSettings
from pamctl.settings import RunSettings


def tracked(settings: RunSettings) -> Merit | None:
    """Simulate a run from the vented muscle; return its figures, or None where safety ended it."""
    rig = settings.rig
    if not isinstance(rig, SimRigSettings):
        raise ValueError("only a simulated rig can be run as a batch")
    period_s = 1.0 / rig.loop.rate_hz
    table = references(segments(settings.experiment), period_s, settings.duration_s)
    run = simulate(
        setup_of(settings),
        plant_parameters(settings.plant),
        sensor_chain(rig.sim, rig.calibration),
        table,
        sensor_noise(len(table), settings.seed),
        period_s=period_s,
        output_delay_ticks=rig.sim.output_delay_ticks,
    )
    if run.tripped_tick >= 0:
        return None
    t_s = np.arange(len(run.rows), dtype=np.float64) * period_s
    return merit(t_s, run["phase"].astype(np.int64), run["position_m"] - run["reference_m"])
