"""The law of another package, as pip would install it, and processes that find it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import IO, cast

from support import super_twisting
from support.command_line import run_pamctl

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


class Elsewhere:
    """A process that finds the packages of a site, and runs one verb after the other.

    A law that a process has found stays in it: here it is hidden from the other tests.
    """

    def __init__(self, site: Path | None = None) -> None:
        paths = [*([site] if site else []), HOUSE, HOUSE / "tests"]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "support.outside_law"],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, *words: object) -> subprocess.CompletedProcess[str]:
        print(json.dumps([*map(str, words)]), file=cast(IO[str], self._process.stdin), flush=True)
        return subprocess.CompletedProcess(**json.loads(self._process.stdout.readline()))  # type: ignore[union-attr]

    def __enter__(self) -> Elsewhere:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever else is printed is no answer
    for line in sys.stdin:
        print(json.dumps(vars(run_pamctl(*json.loads(line)))), file=answers, flush=True)
