"""MAT and HDF5 files: arrays, matrices, structs, and Simulink's "structure with time".

    position_m            an array, 1 x n or n x 1
    yout(:,2), yout(2,:)  a column of a matrix, a row of one that is wider than high
    run.position_m        a field of a struct
    scope.time, scope     a structure with time, and its one signal; scope(2) is its second

The label of a Simulink signal serves as its name if it states a quantity and a unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pamctl.log.importing.column_map import TextHints
from pamctl.log.importing.lab_tables import number_rows
from pamctl.log.importing.measured_table import (
    TIME_S,
    Floats,
    ImportRefused,
    MeasuredTable,
    TableColumn,
    make_columns,
    refuse_bomb,
)

MOST_BYTES = 2 << 30
"""Of one array."""
_DEEPEST = 16
_NUMBERS = {b"", b"double", b"single", b"logical"} | {
    f"{sign}int{bits}".encode() for sign in ("", "u") for bits in (8, 16, 32, 64)
}
"""MATLAB's classes of numbers; nothing where another program wrote the file."""


def parse_mat(path: Path, hints: TextHints) -> MeasuredTable:
    """Return the table of a MAT file to version 7."""
    from scipy.io import loadmat

    try:
        with path.open("rb") as file:  # given a path, loadmat hides why it cannot open the file
            content = loadmat(file, struct_as_record=True, squeeze_me=False)
    # A parser may raise anything for a file that is not a MAT file.
    except Exception as error:
        raise ImportRefused(f"{path} is not a complete MAT file: {error}") from error
    return _make_table(path, {k: v for k, v in content.items() if not k.startswith("__")}, "MAT")


def parse_hdf5(path: Path, hints: TextHints) -> MeasuredTable:
    """Return the table of a MAT file of version 7.3, or of another program's HDF5 file."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            is_matlab = file.userblock_size > 0
            content = {
                name: _read_node(path, file, file[name], 0, is_matlab)
                for name in file
                if not name.startswith("#")
                and isinstance(file.get(name, getlink=True), h5py.HardLink)
            }
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        fix = "save it again, from MATLAB with save(name, ..., '-v7')"
        raise ImportRefused(f"{path} is a damaged HDF5 file: {error}; {fix}") from None
    return _make_table(path, content, "MAT -v7.3" if is_matlab else "HDF5")


def _make_table(path: Path, content: dict[str, Any], form: str) -> MeasuredTable:
    columns: list[TableColumn] = []
    for name, value in content.items():
        try:
            columns += _read_columns(name, value)
        except (ValueError, TypeError, IndexError) as error:
            detail = f"the variable {name} has a form that is not understood ({error})"
            raise ImportRefused(f"{path}: {detail}; save arrays, or structure with time") from error
    if not any(len(column.values) for column in columns):
        detail = "no arrays of numbers: save timeseries objects as structure with time"
        raise ImportRefused(f"{path} holds {detail}")
    return number_rows(columns, form, [])


def _read_columns(name: str, value: Any) -> Iterator[TableColumn]:
    """Yield the columns of a variable or of a field; an object or a text has no numbers."""
    from scipy.io.matlab import MatlabOpaque

    if not isinstance(value, np.ndarray) or isinstance(value, MatlabOpaque):
        yield TableColumn(name, np.zeros(0), is_text=True, says="an object that MATLAB alone reads")
    elif value.dtype.names is not None and value.size == 1:
        yield from _read_struct(name, value.reshape(-1)[0])
    elif value.dtype.names is not None:
        columns = {f"{name}.{field}": value[field] for field in value.dtype.names}
        flat = {key: v.reshape(-1) for key, v in columns.items() if v.dtype.kind in "fiub"}
        yield from make_columns(flat)
    elif value.dtype.kind in "fiub" and value.ndim <= 2:
        yield from _read_array(name, value)
    else:
        yield TableColumn(name, np.zeros(0), is_text=True)


def _read_array(name: str, value: Any) -> Iterator[TableColumn]:
    if value.size < 2:  # it may claim a thousand million columns of nothing
        return
    outer, _, leaf = name.rpartition(".")
    called = TIME_S if leaf == "tout" else leaf if outer else ""
    is_one = value.ndim < 2 or 1 in value.shape
    for column in make_columns([(name, value)]):
        yield replace(column, called=called) if is_one else column


def _read_struct(name: str, record: Any) -> Iterator[TableColumn]:
    fields = {field.lower(): field for field in record.dtype.names}
    if "time" in fields and "signals" in fields:
        yield from _read_structure_with_time(
            name, record[fields["time"]], record[fields["signals"]]
        )
    elif "time" in fields and "data" in fields:
        leaf = name.rpartition(".")[2] if "." in name else ""
        yield TableColumn(f"{name}.time", _flatten(record[fields["time"]]), called=TIME_S)
        yield TableColumn(name, _flatten(record[fields["data"]]), called=leaf)
    else:
        for field in record.dtype.names:
            yield from _read_columns(f"{name}.{field}", record[field])


def _read_structure_with_time(name: str, time: Any, signals: Any) -> Iterator[TableColumn]:
    if np.size(time) > 1:
        yield TableColumn(f"{name}.time", _flatten(time), called=TIME_S)
    each = signals.reshape(-1)
    for index, signal in enumerate(each):
        values = signal["values"]
        label = signal["label"] if "label" in signal.dtype.names else ""
        called = f"{name}({index + 1})" if len(each) > 1 else name
        if values.ndim == 2 and 1 not in values.shape:
            yield from _read_array(called, values)
        else:
            said = str(np.asarray(label).reshape(-1)[0]) if np.size(label) else ""
            leaf = called.rpartition(".")[2] if "." in called else ""
            yield TableColumn(called, _flatten(values), called=said or leaf)


def _flatten(value: Any) -> Floats:
    return np.asarray(value, np.float64).reshape(-1)


# HDF5 into what scipy makes of older MAT files.


def _read_node(path: Path, file: Any, node: Any, depth: int, is_matlab: bool) -> Any:
    import h5py

    if depth > _DEEPEST:
        raise ImportRefused(f"{path}: {node.name} is nested too deeply")
    kind = node.attrs.get("MATLAB_class", b"")
    if isinstance(node, h5py.Group):
        return _read_group(path, file, node, depth, is_matlab)
    size = node.size * node.dtype.itemsize
    if size > MOST_BYTES:
        raise ImportRefused(f"{path}: {node.name} takes {size / 2**30:.1f} GB; save it in parts")
    refuse_bomb(path, size)
    if "MATLAB_empty" in node.attrs:
        return None
    if kind == b"char":
        return np.array(["".join(map(chr, node[()].reshape(-1, order="F")))])
    if node.dtype.names is None and (node.dtype.kind not in "fiub" or kind not in _NUMBERS):
        return None  # an object, a cell
    values = node[()]
    if not is_matlab:
        return np.asarray(values)
    # MATLAB stores the columns one after the other: HDF5 shows the transposed array.
    return np.atleast_2d(values.T) if values.ndim else np.array([[values]])


def _read_group(path: Path, file: Any, group: Any, depth: int, is_matlab: bool) -> Any:
    """Return a struct, or an array of structs, as a record array of shape (1, n)."""
    fields = [name for name in group if not name.startswith("#")]
    if not fields:
        return None
    length = max((group[n].size if _is_list(group[n]) else 1 for n in fields), default=1)
    records = np.empty((1, length), [(name, object) for name in fields])
    for name in fields:
        node = group[name]
        if _is_list(node):
            for index, reference in enumerate(node[()].reshape(-1)):
                one = _read_node(path, file, file[reference], depth + 1, is_matlab)
                records[name][0, index] = one
        else:
            records[name][0, 0] = _read_node(path, file, node, depth + 1, is_matlab)
    return records


def _is_list(node: Any) -> bool:
    """Return whether a field has one value for each struct of an array: references to them."""
    import h5py

    return (
        isinstance(node, h5py.Dataset)
        and h5py.check_ref_dtype(node.dtype) is h5py.Reference
        and "MATLAB_class" not in node.attrs
    )
