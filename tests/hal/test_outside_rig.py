"""A rig from an outside package is found by its entry point, driven and replayed.

The package is a module and an `entry_points.txt` in a directory on PYTHONPATH.
"""

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest
from support.command_line import run_pamctl, run_process
from support.patience import BUSY_PC
from support.processes.daemons import QUICK
from support.runs import run_settings

import pamctl.log
from hal.backend import RigRequest
from hal.rig_contract import RIG_CONTRACT, RigBench
from pamctl.plant.model import plant_parameters
from pamctl.plant.simulated import SimulatedPlant
from pamctl.processes.backends import SHARED_MEMORY, ao_path

pytestmark = pytest.mark.long

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
DEVICE = f"toy-{os.getpid()}"
PATIENT = [f"--set={setting}" for setting in [*BUSY_PC, *QUICK]]

MODULE = '''
"""A bench of another maker: a plant behind a 12-bit output and an ideal sensor."""

import math
from pathlib import Path

from hal.backend import Backend, BuiltRig, RigKeys
from hal.calibration import Zero, calibration, encoder_counts, sensor_v, valve_v
from hal.calibration import Configured
from hal.calibration import Converter, make_output, nearest_output_v
from hal.rig import RawSample, RigError, RigIdentity

OUTPUT = make_output(Converter(10.0, levels=4096.0), 0.0, 10.0)


class ToySettings(Configured):
    device: str = "toy0"


class ToyRig:
    safe_failure = None

    def __init__(self, request):
        self.request, self.file = request, request.output_file
        self.calibration = calibration(request.calibration)
        self.is_open, self.output_v, self.t_ns = False, 0.0, 0

    def open(self):
        self.is_open, self.t_ns = True, self.request.now_ns()
        self.make_safe()

    def read(self):
        t_ns, plant, zero = self.advance(), self.request.plant, Zero(0.2, 1000.4)
        volts = sensor_v(self.calibration, zero, plant.pressure_pa)
        counts = math.floor(encoder_counts(self.calibration, zero, plant.position_m))
        return RawSample(volts, counts, t_ns, t_ns)

    def write(self, ao_v):
        if not math.isfinite(ao_v):
            raise RigError(f"refused to output {ao_v} V", fix="command a finite voltage")
        self.advance()
        return self.put(ao_v)

    def make_safe(self):
        self.put(self.request.safe_volts)

    def close(self):
        self.make_safe()
        self.is_open = False

    def describe(self):
        return RigIdentity("toy", self.request.safe_volts, extra={"bits": 12})

    def advance(self):
        if not self.is_open:
            raise RigError("the toy is not open", fix="call open() first")
        last_ns, self.t_ns = self.t_ns, self.request.now_ns()
        command_v = valve_v(self.calibration, self.output_v)
        self.request.plant.advance(command_v, (self.t_ns - last_ns) * 1e-9)
        return self.t_ns

    def put(self, volts):
        self.output_v = nearest_output_v(OUTPUT, volts)
        if self.file is not None:
            self.file.write_text(str(self.output_v))
        return self.output_v


BACKEND = Backend(
    name="toy",
    description="A bench of another maker.",
    settings=ToySettings,
    rig_file=str(Path(__file__).with_name("toy.yaml")),
    safe_volts=None,
    device=lambda settings: settings.device,
    output=lambda settings: OUTPUT,
    build=lambda request: BuiltRig(ToyRig(request)),
    is_simulated=True,
    keys=RigKeys(pressure_input="toy.device"),
)
'''

ENTRY_POINTS = """
[pamctl.rigs]
toy = toy_rig:BACKEND
torn = toy_rig:NOTHING
"""


class Outside(NamedTuple):
    """A directory with the package, and the environment of a process that sees it."""

    directory: Path
    environment: dict[str, str]


@pytest.fixture(scope="module")
def outside(tmp_path_factory: pytest.TempPathFactory) -> Outside:
    directory = tmp_path_factory.mktemp("site")
    (directory / "toy_rig.py").write_text(MODULE)
    (directory / "toy.yaml").write_text("backend: toy\nsafe_volts: 0.0\n")
    told = directory / "toy_rig-0.1.dist-info"
    told.mkdir()
    (told / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-rig\nVersion: 0.1\n")
    (told / "entry_points.txt").write_text(ENTRY_POINTS)
    path = os.pathsep.join(filter(None, (str(directory), os.environ.get("PYTHONPATH"))))
    return Outside(directory, {**os.environ, "PYTHONPATH": path})


def pamctl_with(
    environment: dict[str, str], *arguments: str, cwd: Path
) -> subprocess.CompletedProcess[str]:
    return run_process([PAMCTL, *arguments], cwd=cwd, env=environment)


@pytest.fixture(scope="module")
def driven(outside: Outside, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the log of a run of one second in real time, patient with a busy machine."""
    cwd = tmp_path_factory.mktemp("run")
    run = ["run", "--backend", "toy", "--duration", "1", "--log", "run.mcap", *PATIENT]
    done = pamctl_with(outside.environment, *run, f"--set=rig.toy.device={DEVICE}", cwd=cwd)
    assert done.returncode == 0, done.stderr
    yield cwd / "run.mcap"
    ao_path(DEVICE).unlink(missing_ok=True)
    (SHARED_MEMORY / f"pamctl-{DEVICE}.lock").unlink(missing_ok=True)


@pytest.fixture
def toy(outside: Outside, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(outside.directory)
    yield importlib.import_module("toy_rig")
    del sys.modules["toy_rig"]


@pytest.mark.parametrize("case", RIG_CONTRACT, ids=lambda case: case.__name__)
def test_the_outside_rig_keeps_the_contract(case, toy):
    settings = run_settings()

    def make_bench() -> RigBench:
        time_ns = [0]

        def now_ns() -> int:
            time_ns[0] += 10_000
            return time_ns[0]

        request = RigRequest(
            settings=toy.ToySettings(),
            calibration=settings.rig.calibration,
            safe_volts=1.25,
            rate_hz=1000.0,
            now_ns=now_ns,
            plant=SimulatedPlant(plant_parameters(settings.plant)),
        )
        built = toy.BACKEND.build(request)
        return RigBench(toy.BACKEND, request, built, lambda: built.rig.output_v)

    case(make_bench)


def test_a_run_drives_it_and_its_log_says_which_package_it_came_from(driven):
    log = pamctl.log.read(driven)
    assert log.metadata["run"]["backend"] == "toy"
    assert log.metadata["run"]["backend_package"] == "toy-rig 0.1"
    assert log.metadata["rig"]["bits"] == "12"
    codes = log["applied_v"] / (20.0 / 4096.0)
    assert (codes == codes.round()).all()
    assert log["applied_v"].max() > 5.0
    assert ao_path(DEVICE).read_text() == "0.0"


def test_its_log_replays_to_the_bit_and_without_the_package_the_package_is_named(driven, outside):
    done = pamctl_with(outside.environment, "replay", str(driven), cwd=driven.parent)
    assert done.returncode == 0, done.stdout + done.stderr
    done = run_pamctl("replay", driven)
    assert done.returncode == 65
    assert "backend 'toy' of the package toy-rig 0.1" in done.stderr


def test_safe_drives_its_safe_voltage(outside, tmp_path):
    chosen = ["--set=rig.safe_volts=2.5", f"--set=rig.toy.device={DEVICE}-safe"]
    try:
        done = pamctl_with(outside.environment, "safe", "--backend", "toy", *chosen, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert float(ao_path(f"{DEVICE}-safe").read_text()) == pytest.approx(2.5, abs=20 / 4096)
    finally:
        ao_path(f"{DEVICE}-safe").unlink(missing_ok=True)


def test_the_doctor_examines_it_and_names_no_key_of_another_backend(outside, tmp_path):
    arguments = ["doctor", "--backend", "toy", "--rt-seconds", "0.1", "--actuate"]
    named = f"--set=rig.toy.device={DEVICE}-doctor"
    done = pamctl_with(outside.environment, *arguments, named, cwd=tmp_path)
    for suffix in ("ao", "lock"):
        ao_path(f"{DEVICE}-doctor").with_suffix(f".{suffix}").unlink(missing_ok=True)
    assert "valve.sign" in done.stdout
    assert "encoder.alive" in done.stdout
    assert "nidaq" not in done.stdout


ASK_ALL = """
import json, sys
from typer.testing import CliRunner
from pamctl.cli.app import app
asked = [CliRunner().invoke(app, words.split()) for words in sys.argv[1:]]
print(json.dumps([(done.exit_code, done.stdout, done.stderr) for done in asked]))
"""


def test_it_is_known_by_its_keys_and_a_package_that_does_not_load_harms_no_other(outside, tmp_path):
    verbs = (
        "config show --backend toy --set rig.toy.devise=x",
        "run --backend torn",
        "config schema",
    )
    done = run_process(
        [sys.executable, "-c", ASK_ALL, *verbs], cwd=tmp_path, env=outside.environment, check=True
    )
    keys, torn, schema = json.loads(done.stdout)
    assert keys[0] == 78
    assert "rig.toy.devise: unknown key; did you mean 'device'?" in keys[2]
    assert torn[0] == 2
    assert "there are sim, nidaq, comedi, toy" in torn[2]
    assert "toy-rig 0.1 does not load: toy_rig:NOTHING: AttributeError" in torn[2] + done.stderr
    assert "ToyRigSettings" in json.loads(schema[1])["$defs"]


def test_a_rig_file_for_a_missing_backend_asks_for_its_package(tmp_path):
    (tmp_path / "rig.yaml").write_text("backend: toy\n")
    done = run_pamctl("config", "show", "--rig", "rig.yaml", cwd=tmp_path)
    assert done.returncode == 78
    assert "must be 'sim', 'nidaq' or 'comedi' (got 'toy'); " in done.stderr
    assert "if a package provides 'toy'" in done.stderr
