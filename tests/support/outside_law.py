"""The law of another package, as pip would install it."""

from __future__ import annotations

import os
import shutil
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
