"""The installed package: the wheel holds all files that the code needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from support.command_line import run_process

pytest.importorskip("hatchling", reason="the build backend is not installed")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel, and unpack it as pip would."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(folder / "site")
    return folder / "site"


def test_every_file_of_the_packages_and_of_config_is_in_the_wheel(installed: Path) -> None:
    def files(folder: Path) -> set[Path]:
        found = (path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder) for path in found if path.suffix != ".pyc"}

    for source, target in (("pamctl", "pamctl"), ("hal", "hal"), ("config", "pamctl/_config")):
        missing = files(ROOT / source) - files(installed / target)
        assert not missing, source
    assert files(ROOT / "config")


def test_elsewhere_a_run_finds_its_configuration_in_the_wheel(
    installed: Path, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "pamctl", "run", "--dry-run", "--json"]
    alone = {**os.environ, "PYTHONPATH": str(installed)}
    done = run_process(command, cwd=tmp_path, env=alone)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["controller"]["law"] == "qsmc"
