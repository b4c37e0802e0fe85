"""What a user writes in Python: forms of experiments, types for an editor, the notebook."""

import ast
import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run_process
from support.made_records import ask_only

import pamctl
from pamctl.base.errors import ExitCode
from pamctl.control.forms import FORMS as FORMS_OF_FILES
from pamctl.diagnose import diagnose
from pamctl.manual import list_pages
from pamctl.session.experiment_form import FORMS, list_keys, list_models
from pamctl.settings.config_files import list_shipped
from pamctl.settings.resolve import resolve, settings_to_data


def test_every_kind_of_an_experiment_file_has_a_form_that_pamctl_offers():
    paper = {"tracking", "square", "steps", "hold", "program"}
    parts = {"pause", "mark", "gains", "repeat"}
    assert {*FORMS} == paper | parts | {"sequence"} | {*FORMS_OF_FILES}
    assert {k for k, f in FORMS.items() if f.IS_PART} == parts | {"move", "valve_move"}
    assert all(getattr(pamctl, form.__name__) is form for form in FORMS.values())
    assert {form.__name__ for form in FORMS.values()} < {*pamctl.__all__}


@pytest.mark.parametrize("kind", FORMS)
def test_the_stub_for_editors_has_the_keys_of_each_form(kind):
    stub = ast.parse((Path(pamctl.__file__).parent / "__init__.pyi").read_text())
    (written,) = (
        node
        for node in stub.body
        if isinstance(node, ast.ClassDef) and node.name == FORMS[kind].__name__
    )
    keys = {
        node.target.id: node.value is None
        for node in written.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    wanted = {key: f.is_required() for key, f in list_keys(list_models()[kind]).items()}
    assert keys == wanted


@pytest.mark.parametrize("name", list_shipped("experiment"))
def test_a_shipped_experiment_written_as_a_form_is_the_same(name):
    data = settings_to_data(resolve(experiment=name).experiment)
    keys = {key: value for key, value in data.items() if key != "kind"}
    if data["kind"] == "sequence":
        keys["parts"] = [write_part(part) for part in keys["parts"]]
    assert FORMS[data["kind"]](**keys).to_data() == data


def write_part(part: dict[str, Any]) -> Any:
    keys = {key: value for key, value in part.items() if key != "kind"}
    if "parts" in keys:
        keys["parts"] = [write_part(inner) for inner in keys["parts"]]
    return FORMS[part["kind"]](**keys)


def test_a_wrong_value_is_refused_when_the_form_is_made():
    with pytest.raises(pamctl.PamctlError, match=r"Sine: experiment.amplitude_mm: ") as refused:
        pamctl.Sine(amplitude_mm=-1, frequency_hz=1)
    assert refused.value.exit_code == ExitCode.BAD_CONFIG


def test_numbers_and_arrays_of_numpy_are_taken():
    t_s = np.linspace(0.0, 1.0, 5)
    table = pamctl.Table(t_s=t_s, values_mm=10.0 + np.sin(t_s))  # type: ignore[arg-type]
    assert table.to_data()["t_s"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    sine = pamctl.Sine(amplitude_mm=np.float64(2.0), frequency_hz=1, cycles=np.int64(3))  # type: ignore[arg-type]
    assert sine.to_data()["cycles"] == 3


def test_a_part_of_a_sequence_is_checked_with_it():
    part = pamctl.Pause(duration_s=-1)
    with pytest.raises(pamctl.PamctlError, match=r"parts\.1\.duration_s"):
        pamctl.MotionSequence(parts=[pamctl.Move(to_mm=9, duration_s=1), part])


# --- types ---------------------------------------------------------------------------------------

ROOT = Path(__file__).resolve().parents[2]

SCRIPT = """
import asyncio
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import pamctl


def steer(rig: pamctl.SteeredRig) -> pamctl.Run:
    rig.goto(12e-3, within_s=2)
    rig.set(lambda_per_s=90, ramp_s=1)
    log: Path = rig.start(pamctl.Chirp(amplitude_mm=1, start_hz=0.5, end_hz=8, duration_s=20))
    for tick in rig.live(rate_hz=10, duration_s=3):
        print(tick["position_m"] * 1e3, log)
    rig.mark("half way")
    parts = [pamctl.Move(to_mm=9, duration_s=1), pamctl.Pause(duration_s=2)]
    rig.run(pamctl.MotionSequence(parts=parts))
    return rig.run("sine", duration_s=5)


with pamctl.connect() as here, pamctl.simulate("paper", controller="pid") as there:
    error_m: NDArray[np.float64] = steer(here).error_m - steer(there).error_m
    try:
        there.run(pamctl.Sine(amplitude_mm=2, frequency_hz=1))
    except pamctl.PamctlError as error:
        print(error.fix, int(error.exit_code), error.log)


async def wait() -> float:
    with pamctl.connect("/tmp/sock") as rig:
        await asyncio.to_thread(rig.goto, 12e-3)
        run = await asyncio.to_thread(rig.run, pamctl.Sine(amplitude_mm=2, frequency_hz=1))
        for tick in rig.live(20):
            print(tick["pressure_pa"])
    return run.metrics.rms_error_m


asyncio.run(wait())
"""
WRONG = """
import pamctl

with pamctl.simulate("paper") as rig:
    rig.goto("12mm")
    pamctl.Sine(amplitude=2, frequency_hz=1)
    rig.run(3)
    rig.metrics
"""


@pytest.mark.long
def test_a_strict_script_has_no_error_and_a_wrong_one_has_each(tmp_path):
    right, wrong = tmp_path / "right.py", tmp_path / "wrong.py"
    right.write_text(SCRIPT)
    wrong.write_text(WRONG)
    # With the house's own settings, which are strict, its cache serves here too.
    settings = ["--config-file", str(ROOT / "pyproject.toml"), "--strict"]
    command = [sys.executable, "-m", "mypy", *settings, str(right), str(wrong)]
    done = run_process(command, cwd=ROOT)
    lines = [line for line in done.stdout.splitlines() if ": error:" in line]
    assert not [line for line in lines if "right.py" in line], done.stdout
    found = {int(line.split(":")[1]) for line in lines if "wrong.py" in line}
    assert found == {5, 6, 7, 8}, done.stdout


# --- the notebook --------------------------------------------------------------------------------

SHORTER = {
    "GENERATIONS = 15": "GENERATIONS = 2",
    "(0.5, 1.0, 2.0)": "(1.0,)",
    '"amplitude_v": 3, "duration_s": 4': '"amplitude_v": 3, "duration_s": 1',
}
"""The same with less of each."""
NOTEBOOK = list_pages()[0].path.parent / "afternoon.ipynb"


@pytest.mark.long
def test_the_notebook_finds_the_dead_band_and_better_gains(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    few = partial(diagnose, without=ask_only("valve_", "null_offset", "opening~", "leak"))
    monkeypatch.setattr("pamctl.diagnose.diagnose", few)
    cells = [c for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"]
    assert not any(cell["outputs"] for cell in cells)
    seen: dict[str, Any] = {}
    done: set[str] = set()
    for number, cell in enumerate(cells, 1):
        source = "".join(cell["source"])
        for long, short in SHORTER.items():
            taken = source.replace(long, short)
            done.update([long] if taken != source else [])
            source = taken
        exec(compile(source, f"cell {number}", "exec"), seen)
    assert done == {*SHORTER}
    assert seen["diagnosis"].verdict == "named"
    effects = settings_to_data(seen["diagnosis"].plant)["effects"]
    assert effects["valve_deadband"]["fill_width_v"] == pytest.approx(0.25, abs=0.01)
    assert "valve deadband" in capsys.readouterr().out
    assert seen["after"].metrics.rms_error_m < seen["before"].metrics.rms_error_m
    assert len(seen["softer"].marks) == 1
    logs = sorted(tmp_path.glob("logs/*.mcap"))
    assert len(logs) == 7
    assert seen["rig"].state == "idle"
    assert all(pamctl.Run.open(log).ending.code == 0 for log in logs)
