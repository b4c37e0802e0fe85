"""The law of another package, and the closed loops of all laws as machine code."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from support import super_twisting

SOURCE = Path(super_twisting.__file__)
HOUSE = Path(__file__).parents[2]


def install_law(site: Path, entry_point: str = "super_twisting = super_twisting:LAW") -> None:
    """Install the package as pip would leave it behind."""
    info = site / "super_twisting_law-1.2.dist-info"
    info.mkdir(parents=True)
    shutil.copy(SOURCE, site)
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: super-twisting-law\nVersion: 1.2\n"
    )
    (info / "entry_points.txt").write_text(f"[pamctl.laws]\n{entry_point}\n")


def path_with(*sites: Path) -> str:
    return os.pathsep.join(map(str, [*sites, HOUSE]))


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
