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

_COMPILE = """
import sys
import numpy as np
from pamctl.plant.drive import drive_coupled, drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.settings.resolve import resolve
from pamctl.simulate.batch import simulate_run
for law in sys.argv[1:]:
    simulate_run(resolve(controller=law, duration_s=0.01))
volts = np.zeros(5)
for terms in ({}, {"terms": {"force": {"operator": "gain", "driver": "position", "size": 1.0}}}):
    p = plant_parameters(PlantSettings.model_validate(terms))
    run = drive_coupled(p, volts, 1e-3)
    drive_pressure(p, volts, run.position_m, 1e-3)
    drive_mechanics(p, run.pressure_pa, 1e-3)
"""

_COMPILE_MORE = """
import numpy as np
from pamctl.gym import MuscleEnv
from pamctl.plant.terms.operators import PlantTerm
from pamctl.plant.terms.tangents import answer_pushes, trace_shape
zeros = np.zeros(5)
answer_pushes(zeros[1:], zeros[1:], trace_shape(PlantTerm(), zeros, zeros[1:])[None])
env = MuscleEnv(duration_s=0.1)
env.reset(seed=1)
env.step(np.zeros(1, np.float32))
"""
"""What single tests need. Beside them, it would take half a minute from a loop in real time."""


def compile_closed_loops(folder: Path) -> None:
    """Leave the closed loop of each law, and the driven plant, in the cache of machine code.

    One process compiles them all: each further law costs it a third of the first, and the drives
    cost it two thirds of what they would alone.
    """
    site, gains = folder / "site", folder / "outside.yaml"
    install_law(site)
    gains.write_text("law: super_twisting\n")
    subprocess.run(
        [sys.executable, "-c", _COMPILE, "qsmc", "smc", "pid", gains],
        env={**os.environ, "PYTHONPATH": path_with(site)},
        check=True,
    )


if __name__ == "__main__":
    with subprocess.Popen([sys.executable, "-c", _COMPILE_MORE]) as more:
        compile_closed_loops(Path(sys.argv[1]))
    sys.exit(more.returncode)
