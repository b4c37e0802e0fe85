"""The house: its rooms, the processes that they start, and the wheel that is built of them."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections import defaultdict
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from support.command_line import run_process
from support.patience import BUSY_PC

import hal
import pamctl
from pamctl.base.worker_processes import start_workers

ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted(path for room in ("pamctl", "hal") for path in (ROOT / room).rglob("*.py"))
PACKAGES = [path for path in MODULES if path.name == "__init__.py"]
MOST_MODULES_IN_A_FOLDER = 16
TOP_LEVEL = {
    ".ci", ".gitignore", ".readme", "LICENSE", "README.md", "config", "hal", "pamctl",
    "pyproject.toml", "scripts", "tests",
}  # fmt: skip
PARTICIPLES = {
    "asked", "begun", "built", "chosen", "composed", "concluded", "corrected", "described",
    "done", "drawn", "driven", "examined", "extended", "fed", "fitted", "forgotten", "found",
    "given", "handed", "heard", "held", "kept", "known", "laid", "logged", "looked", "made",
    "measured", "named", "noted", "opened", "ordered", "paired", "parsed", "picked", "planned",
    "ranked", "recorded", "refused", "rounded", "said", "seen", "sent", "settled", "shown",
    "simulated", "stored", "taken", "told", "tried", "turned", "unpacked", "walked", "weighed",
    "written",
}  # fmt: skip
"""What a function returned was once its name; a function is named by what it does."""


@pytest.mark.skipif(
    shutil.which("git") is None or not (ROOT / ".git").exists(), reason="needs a git clone"
)
def test_nothing_stray_lies_at_the_top_level():
    command = ["git", "-C", str(ROOT), "ls-files"]
    listed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    assert {line.split("/")[0] for line in listed.splitlines()} == TOP_LEVEL


def _name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def _trees() -> list[tuple[Path, ast.Module]]:
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in MODULES]


def _require_unique(places: dict[str, list[str]]) -> None:
    doubled = {name: where for name, where in places.items() if len(where) > 1}
    assert not doubled


def test_no_folder_holds_too_many_modules():
    folders: dict[str, int] = defaultdict(int)
    for path in MODULES:
        folders[_name_of(path.parent)] += path.name != "__init__.py"
    crowded = {name: count for name, count in folders.items() if count > MOST_MODULES_IN_A_FOLDER}
    assert not crowded


def test_no_two_modules_share_a_name():
    """A verb of the command line may be called as the room that does its work.

    `kernel.build` builds machine code, `settings.build` what settings ask for.
    """
    places: dict[str, list[str]] = defaultdict(list)
    for path in MODULES:
        if path.stem == "build":
            continue
        if not path.name.startswith("__") and (ROOT / "pamctl" / "cli") not in path.parents:
            places[path.stem].append(_name_of(path))
    _require_unique(places)


def test_no_two_public_types_share_a_name():
    places: dict[str, list[str]] = defaultdict(list)
    for path, tree in _trees():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(_name_of(path))
    _require_unique(places)


def test_each_folder_says_what_it_is_and_where_to_begin():
    for path in PACKAGES:
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        advice = re.search(r"Read `([^`]+)`", text)
        assert advice, f"{_name_of(path)}: add the line: Read `FILE` first."
        assert (path.parent / advice[1]).exists(), f"{_name_of(path)}: there is no {advice[1]}"


def test_public_functions_are_verbs():
    wrong = [
        f"{_name_of(path)}: {node.name}"
        for path, tree in _trees()
        for room in (tree, *(node for node in tree.body if isinstance(node, ast.ClassDef)))
        for node in room.body
        if isinstance(node, ast.FunctionDef)
        and not any(isinstance(d, ast.Name) and "property" in d.id for d in node.decorator_list)
        and node.name in PARTICIPLES
    ]
    assert not wrong


PAMCTL = str(Path(sys.executable).with_name("pamctl"))
TRAP = """
from pathlib import Path
import sys
(Path(__file__).parent / "sprung").open("a").write(f"{__name__}: {sys.orig_argv}\\n")
"""
STARTERS = {"hal/child.py", "pamctl/base/worker_processes.py"}
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


def test_a_run_takes_no_module_from_the_working_directory(traps):
    device = f"rig.sim.device=traps{os.getpid()}"
    options = [p for one in (device, "rig.homing.enabled=false", *BUSY_PC) for p in ("--set", one)]
    run_verb("run", "--quiet", "--duration", "0.1", "--log", "run.mcap", *options)
    assert not sprung(traps)


def test_an_import_takes_no_module_from_the_working_directory(traps):
    time_s = np.arange(200) * 0.01
    columns = {"t_s": time_s, "valve_v": np.sin(time_s), "position_mm": 10 + np.sin(time_s)}
    columns["pressure_kpa"] = 200 + np.sin(time_s)
    scipy.io.savemat("d.mat", columns)
    run_verb("log", "import", "d.mat", "d.mcap")
    assert not sprung(traps)


def test_workers_take_no_module_from_the_working_directory(traps):
    with start_workers(1) as workers:
        assert workers.submit(os.getcwd).result() == str(traps)
    assert not sprung(traps)


def test_a_process_runs_the_code_of_the_one_that_started_it(tmp_path):
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


def test_nothing_else_starts_python():
    found = []
    for package in (hal, pamctl):
        for path in sorted(Path(str(package.__file__)).parent.rglob("*.py")):
            place = path.relative_to(ROOT).as_posix()
            if place not in STARTERS:
                found += [f"{place}:{line}" for line in find_starts(path.read_text())]
    assert not found, "use hal.child.child_command or pamctl.base.worker_processes.start_workers"


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


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel, and unpack it as pip would."""
    pytest.importorskip("hatchling", reason="the build backend is not installed")
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(folder / "site")
    return folder / "site"


def test_every_file_of_the_packages_and_of_config_is_in_the_wheel(installed):
    def files(folder: Path) -> set[Path]:
        found = (path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder) for path in found if path.suffix != ".pyc"}

    for source, target in (("pamctl", "pamctl"), ("hal", "hal"), ("config", "pamctl/_config")):
        missing = files(ROOT / source) - files(installed / target)
        assert not missing, source
    assert files(ROOT / "config")


def test_elsewhere_a_run_finds_its_configuration_in_the_wheel(installed, tmp_path):
    command = [sys.executable, "-m", "pamctl", "run", "--dry-run", "--json"]
    alone = {**os.environ, "PYTHONPATH": str(installed)}
    done = run_process(command, cwd=tmp_path, env=alone)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["controller"]["law"] == "qsmc"
