"""What all experiments of a session share: they are checked as an experiment file is."""

from __future__ import annotations

import collections.abc
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, dataclass_transform

from pamctl.session.pamctl_error import translate_errors

Floats = collections.abc.Sequence[float]
"""Numbers: a list, a tuple, or `array.tolist()`."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
class ExperimentForm:
    """An experiment, or a part of one, with the keys and the units of an experiment file.

    A wrong value raises `PamctlError` when the form is made: nothing has moved then. Each subclass
    is a frozen dataclass; `kind` is its kind in a file, and a part stands within a sequence only.
    """

    KIND: ClassVar[str] = ""
    IS_PART: ClassVar[bool] = False
    """It is checked with its sequence."""

    def __init_subclass__(cls, kind: str = "", is_part: bool = False) -> None:
        """Make a dataclass of a subclass."""
        cls.KIND, cls.IS_PART = kind, is_part
        dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        """Check the values."""
        if not self.IS_PART:
            self.to_data()

    def to_data(self) -> dict[str, Any]:
        """Return the keys of an experiment file; the points of a table's file are read."""
        return read_experiment(self._write_keys(), type(self).__name__)

    def _write_keys(self) -> dict[str, Any]:
        fields_of: Any = self  # every subclass is a dataclass
        keys = {field.name: _make_plain(getattr(self, field.name)) for field in fields(fields_of)}
        return {"kind": self.KIND, **{key: v for key, v in keys.items() if v is not None}}


def read_experiment(data: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return checked keys of an experiment; raise `PamctlError` that calls it `name`."""
    from pamctl.settings.resolve import SECTIONS, RawSettings, settings_to_data, validate_settings
    from pamctl.settings.table_file import read_tables

    with translate_errors():
        raw = RawSettings({**data}, {(): name})
        read_tables(raw)
        return settings_to_data(validate_settings(SECTIONS["experiment"], raw, title="experiment"))


def _make_plain(value: object) -> Any:
    """Return a value as JSON has it."""
    if isinstance(value, ExperimentForm):
        return value._write_keys()
    if isinstance(value, Mapping):
        return {str(key): _make_plain(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    to_list = getattr(value, "tolist", None)  # numbers and arrays of numpy
    if to_list is not None:
        return to_list()
    if isinstance(value, list | tuple):
        return [_make_plain(item) for item in value]
    return value
