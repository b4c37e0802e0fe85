"""The experiments of a session have the keys, defaults and bounds of an experiment file."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pamctl
from pamctl.control.forms import FORMS as FORMS_OF_FILES
from pamctl.exit_codes import ExitCode
from pamctl.session.experiment_form import FORMS, list_keys, list_models
from pamctl.settings.config_files import list_shipped
from pamctl.settings.resolve import resolve, settings_to_data


def test_every_kind_of_an_experiment_file_has_a_form_that_pamctl_offers() -> None:
    paper = {"tracking", "square", "steps", "hold", "program"}
    parts = {"pause", "mark", "gains", "repeat"}
    assert {*FORMS} == paper | parts | {"sequence"} | {*FORMS_OF_FILES}
    assert {k for k, f in FORMS.items() if f.IS_PART} == parts | {"move", "valve_move"}
    assert all(getattr(pamctl, form.__name__) is form for form in FORMS.values())
    assert {form.__name__ for form in FORMS.values()} < {*pamctl.__all__}


@pytest.mark.parametrize("kind", FORMS)
def test_the_stub_for_editors_has_the_keys_of_each_form(kind: str) -> None:
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
def test_a_shipped_experiment_written_as_a_form_is_the_same(name: str) -> None:
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


def test_a_wrong_value_is_refused_when_the_form_is_made() -> None:
    with pytest.raises(pamctl.PamctlError, match=r"Sine: experiment.amplitude_mm: ") as refused:
        pamctl.Sine(amplitude_mm=-1, frequency_hz=1)
    assert refused.value.exit_code == ExitCode.BAD_CONFIG


def test_numbers_and_arrays_of_numpy_are_taken() -> None:
    t_s = np.linspace(0.0, 1.0, 5)
    table = pamctl.Table(t_s=t_s, values_mm=10.0 + np.sin(t_s))  # type: ignore[arg-type]
    assert table.to_data()["t_s"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    sine = pamctl.Sine(amplitude_mm=np.float64(2.0), frequency_hz=1, cycles=np.int64(3))  # type: ignore[arg-type]
    assert sine.to_data()["cycles"] == 3


def test_a_part_of_a_sequence_is_checked_with_it() -> None:
    part = pamctl.Pause(duration_s=-1)
    with pytest.raises(pamctl.PamctlError, match=r"parts\.1\.duration_s"):
        pamctl.MotionSequence(parts=[pamctl.Move(to_mm=9, duration_s=1), part])
