"""The hidden rig under pamctl's own loop and its own experiment, as its log would hold it."""

from __future__ import annotations

import numpy as np
from support.runs import run, run_settings

from hidden.plant import HiddenPlant
from hidden.rig import HiddenRig, Record
from pamctl.signals import Phase

DRIVER_OFFSET_V = 5.0
"""AO 5 V is a closed valve (DESIGN 4: command)."""


def own_run(rig: HiddenRig, experiment: str, seed: int) -> Record:
    """Run an open-loop experiment to its end; read the ticks as `pamctl.log.signals` does."""
    noise_v = rig.sensors.pressure_noise_pa * 6.43e-6  # of a sensor of 6.43 mV/kPa
    settings = run_settings(
        f"experiment.seed={seed}",
        f"rig.sim.sensor_noise_v={noise_v}",
        experiment=experiment,
        seed=rig.seed + seed,
    )
    ticks = run(settings, plant=HiddenPlant(rig)).journal.ticks
    rows = np.array(
        [
            (r.timing.t_s, r.outcome.applied_v - DRIVER_OFFSET_V,
             r.measurement.pressure_pa, r.measurement.position_m)
            for r in ticks
            if r.reference.phase == Phase.OPEN_LOOP
        ]
    )  # fmt: skip
    t_s = rows[:, 0] - rows[0, 0]
    return Record(f"{experiment}-{seed}", t_s, rows[:, 1], rows[:, 2], rows[:, 3])
