"""Machine code that many tests need: compiled once, before or by the first that asks for it.

PYTHONPATH=tests python -m support.machine_code FOLDER
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from support.outside_law import install_law, path_with

READY = "PAMCTL_TESTS_ARE_COMPILED"
"""In the environment of a run of the tests that found everything compiled."""

_COMPILE_LAWS = """
import sys
from pamctl.settings.resolve import resolve
from pamctl.simulate.batch import simulate_run
for law in sys.argv[1:]:
    simulate_run(resolve(controller=law, duration_s=0.01))
"""

_COMPILE_PLANT = """
import numpy as np
from pamctl.gym import MuscleEnv
from pamctl.plant.drive import drive_coupled, drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.terms.operators import PlantTerm
from pamctl.plant.terms.tangents import answer_pushes, trace_shape
volts = np.zeros(5)
for terms in ({}, {"terms": {"force": {"operator": "gain", "driver": "position", "size": 1.0}}}):
    p = plant_parameters(PlantSettings.model_validate(terms))
    run = drive_coupled(p, volts, 1e-3)
    drive_pressure(p, volts, run.position_m, 1e-3)
    drive_mechanics(p, run.pressure_pa, 1e-3)
answer_pushes(volts[1:], volts[1:], trace_shape(PlantTerm(), volts, volts[1:])[None])
env = MuscleEnv(duration_s=0.1)
env.reset(seed=1)
env.step(np.zeros(1, np.float32))
"""


def compile_kernels(folder: Path) -> None:
    """Leave the closed loop of each law, and the driven plant, in the cache of machine code.

    Two processes take two minutes of a quiet CPU each. In one of them a further law costs a third
    of the first, and the plant with terms less than alone.
    """
    site, gains = folder / "site", folder / "outside.yaml"
    install_law(site)
    gains.write_text("law: super_twisting\n")
    with subprocess.Popen([sys.executable, "-c", _COMPILE_PLANT]) as plant:
        subprocess.run(
            [sys.executable, "-c", _COMPILE_LAWS, "qsmc", "smc", "pid", gains],
            env={**os.environ, "PYTHONPATH": path_with(site)},
            check=True,
        )
    if plant.returncode:
        raise subprocess.CalledProcessError(plant.returncode, plant.args)


if __name__ == "__main__":
    compile_kernels(Path(sys.argv[1]))
