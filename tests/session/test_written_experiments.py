"""The experiments of a session have the keys, defaults and bounds of an experiment file."""

from __future__ import annotations

import dataclasses
import typing
from typing import Any

import numpy as np
import pytest

import pamctl
from pamctl.control.experiment import (
    ExperimentSettings,
    HoldSettings,
    ProgramSettings,
    SquareSettings,
    StepsSettings,
    TrackingSettings,
)
from pamctl.control.references.kinds import MuscleMoveSettings, StandingForm, ValveMoveSettings
from pamctl.control.references.sequence import (
    GainsPart,
    MarkPart,
    PausePart,
    RepeatPart,
    SequenceSettings,
)
from pamctl.exit_codes import ExitCode
from pamctl.session import motion_sequence, reference_forms
from pamctl.settings.config_files import list_shipped
from pamctl.settings.resolve import resolve, settings_to_data

MODELS: list[Any] = [
    TrackingSettings, SquareSettings, StepsSettings, ProgramSettings, HoldSettings,
    *typing.get_args(StandingForm), MuscleMoveSettings, ValveMoveSettings,
    PausePart, MarkPart, GainsPart, RepeatPart, SequenceSettings,
]  # fmt: skip
FORMS: dict[str, Any] = {
    form.KIND: form
    for module in (reference_forms, motion_sequence)
    for form in vars(module).values()
    if isinstance(form, type) and getattr(form, "KIND", "")
}


def kind_of(model: Any) -> str:
    (kind,) = typing.get_args(model.model_fields["kind"].annotation)
    return str(kind)


def test_every_kind_of_an_experiment_file_has_a_form_that_pamctl_offers() -> None:
    assert {kind_of(model) for model in MODELS} == {*FORMS}
    in_files = {
        kind_of(model)
        for union in typing.get_args(typing.get_args(ExperimentSettings)[0])
        for model in (typing.get_args(union) or (union,))
    }
    assert in_files == {kind for kind, form in FORMS.items() if not form.IS_PART}
    assert all(getattr(pamctl, form.__name__) is form for form in FORMS.values())


@pytest.mark.parametrize("model", MODELS, ids=kind_of)
def test_a_form_has_the_keys_and_defaults_of_its_kind(model: Any) -> None:
    to_key = model.model_config.get("alias_generator") or (lambda name: name)
    wanted = {
        to_key(name): dataclasses.MISSING if field.is_required() else field.default
        for name, field in model.model_fields.items()
        if name != "kind"
    }
    form = FORMS[kind_of(model)]
    assert {field.name: field.default for field in dataclasses.fields(form)} == wanted


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
