"""The experiments of a session: each kind of an experiment file as a class.

The classes are made from the models of the file, so they have its keys, units, defaults and bounds:
`kind: valve_sine` is `pamctl.ValveSine`. `pamctl/__init__.pyi` writes them out for type checkers
and editors; `scripts/generate_reference.py` makes it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, dataclass_transform

from pydantic.fields import FieldInfo

from pamctl.control import experiment
from pamctl.control.forms import Drawn
from pamctl.session.pamctl_error import translate_errors

_OTHER_NAMES = {"program": "ExcitationProgram", "repeat": "Repeats", "sequence": "MotionSequence"}


@dataclass_transform(frozen_default=True, kw_only_default=True)
class ExperimentForm:
    """An experiment, or a part of one, with the keys and the units of an experiment file.

    A wrong value raises `PamctlError` when the form is made: nothing has moved then. Each subclass
    is a frozen dataclass; `kind` is its kind in a file, and a part stands within a sequence only.
    """

    KIND: ClassVar[str] = ""
    IS_PART: ClassVar[bool] = False
    """It is checked with its sequence."""

    def __post_init__(self) -> None:
        """Check the values."""
        if not self.IS_PART:
            self.to_data()

    def to_data(self) -> dict[str, Any]:
        """Return the keys of an experiment file; the points of a table's file are read."""
        return read_experiment(_make_plain(self), type(self).__name__)


def read_experiment(data: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return checked keys of an experiment; raise `PamctlError` that calls it `name`."""
    from pamctl.settings.config_files import read_tables
    from pamctl.settings.resolve import SECTIONS, RawSettings, settings_to_data, validate_settings

    with translate_errors():
        raw = RawSettings({**data}, {(): name})
        read_tables(raw)
        return settings_to_data(validate_settings(SECTIONS["experiment"], raw, title="experiment"))


def _make_plain(value: Any) -> Any:
    """Return a value as JSON has it."""
    if isinstance(value, ExperimentForm):
        keys = vars(value).items()
        return {"kind": value.KIND, **{k: _make_plain(v) for k, v in keys if v is not None}}
    if isinstance(value, Mapping):
        return {str(key): _make_plain(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    to_list = getattr(value, "tolist", None)  # numbers and arrays of numpy
    if to_list is not None:
        return to_list()
    return [_make_plain(item) for item in value] if isinstance(value, list | tuple) else value


def list_models() -> dict[str, type[Drawn]]:
    """Return the model of every kind, experiments and parts of them."""
    kinds = dict.fromkeys((*experiment.EXPERIMENTS, *experiment.PARTS))
    return {kind: experiment.find_model(kind) for kind in kinds}


def list_keys(model: type[Drawn]) -> dict[str, FieldInfo]:
    """Return the keys of a file's model, but `kind`."""
    to_key: Any = model.model_config.get("alias_generator") or str
    return {to_key(name): field for name, field in model.model_fields.items() if name != "kind"}


def _make_form(kind: str, model: type[Drawn]) -> type[ExperimentForm]:
    fields = [
        (key, Any, dataclasses.field(default=dataclasses.MISSING if f.is_required() else f.default))
        for key, f in list_keys(model).items()
    ]
    return dataclasses.make_dataclass(
        _OTHER_NAMES.get(kind, kind.title().replace("_", "")),
        fields,
        bases=(ExperimentForm,),
        namespace={
            "KIND": kind,
            "IS_PART": model.IS_PART,
            "__doc__": model.__doc__,
            "__module__": __name__,  # pickle looks for it here
        },
        frozen=True,
        kw_only=True,
    )


FORMS: dict[str, Any] = {kind: _make_form(kind, model) for kind, model in list_models().items()}
"""The classes by their kind in a file."""
globals().update({form.__name__: form for form in FORMS.values()})
