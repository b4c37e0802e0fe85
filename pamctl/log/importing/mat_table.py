"""Read a MAT file: arrays, matrices, structs, and Simulink's "structure with time".

    position_m            an array, 1 x n or n x 1
    yout(:,2)             a column of a matrix
    run.position_m        a field of a struct
    scope.time, scope     a structure with time, and its one signal; scope(2) is its second

The label of a Simulink signal serves as its name if it states a quantity and a unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io.matlab import MatlabOpaque

from pamctl.log.importing.measured_table import Floats, ImportRefused, MeasuredTable
from pamctl.log.importing.parse_apart import parse_apart

_SIMULINK_TIME = "time_s"
"""Simulink's own time (`tout`, and the time of its structures) is in seconds."""


class _Column(NamedTuple):
    name: str
    values: Floats
    called: str = ""


def read_mat(path: Path) -> MeasuredTable:
    """Read a file in a process of its own; raise ImportRefused with the fix if it cannot be."""
    return parse_apart(path)


def parse_mat(path: Path) -> MeasuredTable:
    """Read a file in this process; raise ImportRefused with the fix if that is impossible."""
    from scipy.io import loadmat

    try:
        with path.open("rb") as file:  # given a path, loadmat hides why it cannot open the file
            content = loadmat(file, struct_as_record=True, squeeze_me=False)
    except NotImplementedError:  # version 7.3: an HDF5 file
        content = _read_version_7_3(path)
    except OSError as error:
        raise ImportRefused(f"cannot read {path}: {error.strerror or error}") from error
    # A parser may raise anything for a file that is not a MAT file.
    except Exception as error:
        raise ImportRefused(f"{path} is not a complete MAT file: {error}") from error
    columns = []
    for name, value in content.items():
        try:
            columns += [] if name.startswith("__") else list(_read_columns(name, value))
        except (ValueError, TypeError, IndexError) as error:
            detail = f"the variable {name} has a form that is not understood ({error})"
            raise ImportRefused(f"{path}: {detail}; save arrays, or structure with time") from error
    if not columns:
        detail = "no arrays of numbers: save timeseries objects as structure with time"
        raise ImportRefused(f"{path} holds {detail}")
    longest = max(len(column.values) for column in columns)
    return MeasuredTable(
        {column.name: column.values for column in columns},
        np.arange(1, longest + 1),
        {column.name: column.called for column in columns if column.called},
    )


def _read_version_7_3(path: Path) -> dict[str, Any]:
    try:
        from pamctl.log.importing.lab_files.mat73_content import load_mat73
    except ModuleNotFoundError:
        detail = "is a MAT file of version 7.3: install h5py with pip install '.[labfiles]'"
        way_out = "save it again with save(name, ..., '-v7')"
        raise ImportRefused(f"{path} {detail}, or {way_out}") from None
    return load_mat73(path)


def _read_columns(name: str, value: Any) -> Iterator[_Column]:
    """Yield the columns of a variable or of a field; objects and texts have none."""
    if not isinstance(value, np.ndarray) or isinstance(value, MatlabOpaque):
        return
    if value.dtype.names is not None:
        if value.size == 1:
            yield from _read_struct(name, value.reshape(-1)[0])
    elif value.dtype.kind in "fiub" and value.ndim == 2:
        yield from _read_array(name, value)


def _read_array(name: str, value: NDArray[Any]) -> Iterator[_Column]:
    if not value.size:  # it may claim a thousand million columns of nothing
        return
    called = _SIMULINK_TIME if name.rpartition(".")[2] == "tout" else ""
    if 1 in value.shape:
        if value.size > 1:
            yield _Column(name, value.reshape(-1).astype(float), called or _leaf_name(name))
        return
    for index in range(value.shape[1]):
        yield _Column(f"{name}(:,{index + 1})", value[:, index].astype(float))


def _leaf_name(name: str) -> str:
    """Return the last part of a field's name, an empty text for a variable."""
    outer, _, leaf = name.rpartition(".")
    return leaf if outer else ""


def _read_struct(name: str, record: Any) -> Iterator[_Column]:
    fields = {field.lower(): field for field in record.dtype.names}
    if "time" in fields and "signals" in fields:
        yield from _read_structure_with_time(
            name, record[fields["time"]], record[fields["signals"]]
        )
    elif "time" in fields and "data" in fields:
        yield _Column(f"{name}.time", _flatten_values(record[fields["time"]]), _SIMULINK_TIME)
        yield _Column(name, _flatten_values(record[fields["data"]]), _leaf_name(name))
    else:
        for field in record.dtype.names:
            yield from _read_columns(f"{name}.{field}", record[field])


def _read_structure_with_time(name: str, time: Any, signals: Any) -> Iterator[_Column]:
    if np.size(time) > 1:
        yield _Column(f"{name}.time", _flatten_values(time), _SIMULINK_TIME)
    each = signals.reshape(-1)
    for index, signal in enumerate(each):
        values, label = signal["values"], _read_label(signal)
        called = f"{name}({index + 1})" if len(each) > 1 else name
        if values.ndim == 2 and 1 not in values.shape:
            yield from _read_array(called, values)
        else:
            yield _Column(called, _flatten_values(values), label or _leaf_name(name))


def _flatten_values(value: Any) -> Floats:
    return np.asarray(value, float).reshape(-1)


def _read_label(signal: Any) -> str:
    label = signal["label"] if "label" in signal.dtype.names else ""
    return str(np.asarray(label).reshape(-1)[0]) if np.size(label) else ""
