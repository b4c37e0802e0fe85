"""MAT and HDF5 files, as MATLAB and others write them.

A file may hold arrays, matrices, structs, and Simulink's "structure with time":

    position_m            an array, 1 x n or n x 1
    yout(:,2), yout(2,:)  a column of a matrix, a row of one that is wider than high
    run.position_m        a field of a struct
    scope.time, scope     a structure with time, and its one signal; scope(2) is its second
    enc.data, enc.unit    an array and its unit; in HDF5 an array's attribute `unit` or `units`

The label of a Simulink signal serves as its name if it states a quantity and a unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.log.importing.column_map import TextHints
from pamctl.log.importing.measured_table import (
    TIME_S,
    Floats,
    ImportRefused,
    MeasuredTable,
    TableColumn,
    make_columns,
    number_rows,
    refuse_bomb,
)

MOST_BYTES = 2 << 30
"""Of one array."""
_DEEPEST = 16
_NUMBERS = {b"", b"double", b"single", b"logical"} | {
    f"{sign}int{bits}".encode() for sign in ("", "u") for bits in (8, 16, 32, 64)
}
"""MATLAB's classes of numbers; nothing where another program wrote the file."""


class _WithUnit(NamedTuple):
    """An array of HDF5 that states its unit."""

    values: NDArray[Any]
    unit: str


def parse_mat(path: Path, hints: TextHints) -> MeasuredTable:
    """Return the table of a MAT file to version 7."""
    from scipy.io import loadmat

    try:
        with path.open("rb") as file:  # given a path, loadmat hides why it cannot open the file
            content = loadmat(file, simplify_cells=True)
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
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            detail = f"the variable {name} has a form that is not understood ({error})"
            raise ImportRefused(f"{path}: {detail}; save arrays, or structure with time") from error
    if not any(len(column.values) for column in columns):
        detail = "no arrays of numbers: save timeseries objects as structure with time"
        raise ImportRefused(f"{path} holds {detail}")
    return number_rows(columns, form, [])


def _read_columns(name: str, value: Any) -> Iterator[TableColumn]:
    """Yield the columns of a variable or of a field, as `loadmat` simplifies it."""
    from scipy.io.matlab import MatlabOpaque

    match value:
        case None | MatlabOpaque():
            says = "an object that MATLAB alone reads"
            yield TableColumn(name, np.zeros(0), is_text=True, says=says)
        case dict():
            yield from _read_struct(name, value)
        case _WithUnit():
            yield from (replace(c, unit=value.unit) for c in _read_columns(name, value.values))
        case [dict(), *_]:
            fields = {field: np.array([each[field] for each in value]) for field in value[0]}
            yield from _read_fields(name, fields)
        case np.ndarray() if value.dtype.names is not None:
            yield from _read_fields(name, {field: value[field] for field in value.dtype.names})
        case np.ndarray() if value.dtype.kind in "fiub" and value.ndim <= 2:
            yield from _read_array(name, value)
        case str() | np.ndarray():
            yield TableColumn(name, np.zeros(0), is_text=True)


def _read_fields(name: str, fields: dict[str, Any]) -> list[TableColumn]:
    """Return the columns of an array of structs, a number a field."""
    numbers = {f: values.reshape(-1) for f, values in fields.items() if values.dtype.kind in "fiub"}
    return make_columns({f"{name}.{field}": values for field, values in numbers.items()})


def _read_array(name: str, value: Any) -> Iterator[TableColumn]:
    if value.size < 2:  # it may claim a thousand million columns of nothing
        return
    outer, _, leaf = name.rpartition(".")
    called = TIME_S if leaf == "tout" else leaf if outer else ""
    is_one = value.ndim < 2 or 1 in value.shape
    for column in make_columns([(name, value)]):
        yield replace(column, called=called) if is_one else column


def _read_struct(name: str, struct: dict[str, Any]) -> Iterator[TableColumn]:
    fields = {field.lower(): value for field, value in struct.items()}
    if "time" in fields and "signals" in fields:
        yield from _read_structure_with_time(name, fields["time"], fields["signals"])
    elif "data" in fields and (unit := _find_unit(fields)):
        for column in _read_columns(f"{name}.data", fields["data"]):
            yield replace(column, unit=unit, called=_find_leaf(name))
    elif "time" in fields and "data" in fields:
        # A time that states its own unit is read by it.
        for column in _read_columns(f"{name}.time", fields["time"]):
            yield column if column.unit else replace(column, called=TIME_S)
        for column in _read_columns(name, fields["data"]):
            yield replace(column, called=_find_leaf(name))
    else:
        for field, value in struct.items():
            yield from _read_columns(f"{name}.{field}", value)


def _find_unit(said: Mapping[str, Any]) -> str:
    """Return the unit that the fields of a struct, or attributes of an array, state; or nothing."""
    unit = next((value for key, value in said.items() if key.lower() in ("unit", "units")), "")
    unit = unit.item() if isinstance(unit, np.ndarray) and unit.size == 1 else unit
    unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit
    return unit.strip() if isinstance(unit, str) else ""


def _read_structure_with_time(name: str, time: Any, signals: Any) -> Iterator[TableColumn]:
    if np.size(time) > 1:
        yield TableColumn(f"{name}.time", _flatten(time), called=TIME_S)
    each = signals if isinstance(signals, list) else [signals]
    for number, signal in enumerate(each, 1):
        values, label = np.asarray(signal["values"]), signal.get("label")
        called = f"{name}({number})" if len(each) > 1 else name
        if values.ndim == 2 and 1 not in values.shape:
            yield from _read_array(called, values)
        else:
            said = label if isinstance(label, str) else ""
            yield TableColumn(called, _flatten(values), called=said or _find_leaf(called))


def _find_leaf(name: str) -> str:
    """Return the name of a field; nothing for a variable."""
    return name.rpartition(".")[2] if "." in name else ""


def _flatten(value: Any) -> Floats:
    return np.asarray(value, np.float64).reshape(-1)


# --- HDF5 into what `loadmat` makes of older MAT files ------------------------------------------


def _read_node(path: Path, file: Any, node: Any, depth: int, is_matlab: bool) -> Any:
    import h5py

    if depth > _DEEPEST:
        raise ImportRefused(f"{path}: {node.name} is nested too deeply")

    def read(inner: Any) -> Any:
        return _read_node(path, file, inner, depth + 1, is_matlab)

    if isinstance(node, h5py.Group):
        fields = {name: node[name] for name in node if not name.startswith("#")}
        if not fields or not all(map(_is_list, fields.values())):
            return {name: read(field) for name, field in fields.items()} or None
        columns = [field[()].reshape(-1) for field in fields.values()]
        rows = zip(*columns, strict=True)
        return [dict(zip(fields, (read(file[ref]) for ref in row), strict=True)) for row in rows]
    kind, size = node.attrs.get("MATLAB_class", b""), node.size * node.dtype.itemsize
    if size > MOST_BYTES:
        raise ImportRefused(f"{path}: {node.name} takes {size / 2**30:.1f} GB; save it in parts")
    refuse_bomb(path, size)
    if "MATLAB_empty" in node.attrs:
        return None
    if kind == b"char":
        return "".join(map(chr, node[()].reshape(-1, order="F")))
    if node.dtype.names is None and (node.dtype.kind not in "fiub" or kind not in _NUMBERS):
        return None  # an object, a cell
    # MATLAB stores the columns one after the other: HDF5 shows the transposed array.
    values = np.asarray(node[()]).T.squeeze() if is_matlab else np.asarray(node[()])
    unit = _find_unit(node.attrs)
    return _WithUnit(values, unit) if unit else values


def _is_list(node: Any) -> bool:
    """Return whether a field has one value for each struct of an array: references to them."""
    import h5py

    return (
        isinstance(node, h5py.Dataset)
        and h5py.check_ref_dtype(node.dtype) is h5py.Reference
        and "MATLAB_class" not in node.attrs
    )
