"""Processes that pamctl starts run its own modules, whatever lies in the working directory."""

from __future__ import annotations

import ast
import os
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from support.command_line import run_process
from support.patience import BUSY_PC

import hal
import pamctl
from pamctl.worker_processes import start_workers

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
TRAP = """
from pathlib import Path
import sys
(Path(__file__).parent / "sprung").open("a").write(f"{__name__}: {sys.orig_argv}\\n")
"""
ROOT = Path(pamctl.__file__).parents[1]
STARTERS = {"hal/child.py", "pamctl/worker_processes.py"}
"""Who may start Python: the one helper, and the one pool of workers."""
WAYS = {
    "executable", "_base_executable", "get_context", "ProcessPoolExecutor", "Pool", "fork",
    "forkserver", "set_start_method", "create_subprocess_exec", "create_subprocess_shell",
}  # fmt: skip


@pytest.fixture
def traps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with a module of every name that a process might import."""
    for name in {*sys.stdlib_module_names, *packages_distributions(), "hal", "pamctl"}:
        (tmp_path / f"{name}.py").write_text(TRAP)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def sprung(traps: Path) -> str:
    found = traps / "sprung"
    return found.read_text() if found.exists() else ""


def run_verb(*words: str) -> str:
    done = run_process([PAMCTL, *words])
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_a_run_takes_no_module_from_the_working_directory(traps: Path) -> None:
    device = f"rig.sim.device=traps{os.getpid()}"
    options = [p for one in (device, "rig.homing.enabled=false", *BUSY_PC) for p in ("--set", one)]
    run_verb("run", "--quiet", "--duration", "0.1", "--log", "run.mcap", *options)
    assert not sprung(traps)


def test_an_import_takes_no_module_from_the_working_directory(traps: Path) -> None:
    time_s = np.arange(200) * 0.01
    columns = {"t_s": time_s, "valve_v": np.sin(time_s), "position_mm": 10 + np.sin(time_s)}
    columns["pressure_kpa"] = 200 + np.sin(time_s)
    scipy.io.savemat("d.mat", columns)
    run_verb("log", "import", "d.mat", "d.mcap")
    assert not sprung(traps)


def test_workers_take_no_module_from_the_working_directory(traps: Path) -> None:
    with start_workers(1) as workers:
        assert workers.submit(os.getcwd).result() == str(traps)
    assert not sprung(traps)


def test_a_process_runs_the_code_of_the_one_that_started_it(tmp_path: Path) -> None:
    """Also where another checkout is installed than the one that `python -m pamctl` runs."""
    for package in ("hal", "pamctl"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    (tmp_path / "hal/child.py").write_bytes((ROOT / "hal/child.py").read_bytes())
    (tmp_path / "pamctl/who.py").write_text("print(__file__)")
    (tmp_path / "pamctl/front.py").write_text(
        "import subprocess\nfrom hal.child import child_command\n"
        "subprocess.run(child_command('pamctl.who'), check=True)"
    )
    front = [sys.executable, "-m", "pamctl.front"]
    done = run_process(front, cwd=tmp_path, check=True)
    assert done.stdout.strip() == str(tmp_path / "pamctl/who.py")


def test_nothing_else_starts_python() -> None:
    found = []
    for package in (hal, pamctl):
        for path in sorted(Path(str(package.__file__)).parent.rglob("*.py")):
            place = path.relative_to(ROOT).as_posix()
            if place not in STARTERS:
                found += [f"{place}:{line}" for line in find_starts(path.read_text())]
    assert not found, "use hal.child.child_command or cluster.worker_processes.start_workers"


def find_starts(source: str) -> list[int]:
    """List the lines that name a way to start Python."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if (isinstance(node, ast.Attribute) and node.attr in WAYS)
        or (isinstance(node, ast.Name) and node.id in WAYS)
        or (isinstance(node, ast.ImportFrom) and any(one.name in WAYS for one in node.names))
        or (isinstance(node, ast.Constant) and node.value == "-m")
    ]
