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
from pamctl.settings.resolve import resolve
from pamctl.simulate.batch import simulate_run
for law in sys.argv[1:]:
    simulate_run(resolve(controller=law, duration_s=0.01))
"""


def compile_closed_loops(folder: Path) -> None:
    """Leave the closed loop of each law in the cache of machine code.

    One process compiles them all: each further law costs it a third of the first.
    """
    site, gains = folder / "site", folder / "outside.yaml"
    install_law(site)
    gains.write_text("law: super_twisting\n")
    subprocess.run(
        [sys.executable, "-c", _COMPILE, "qsmc", "smc", "pid", gains],
        env={**os.environ, "PYTHONPATH": path_with(site)},
        check=True,
    )
