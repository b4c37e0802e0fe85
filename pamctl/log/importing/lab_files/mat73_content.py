"""Read a MAT file of version 7.3, an HDF5 file, into what scipy makes of older versions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pamctl.log.importing.measured_table import ImportRefused

MOST_BYTES = 2 << 30
"""Of one array: compressed, a file of a few bytes may claim any size."""
_DEEPEST = 16
_NUMBERS = {b"", b"double", b"single", b"logical"} | {
    f"{sign}int{bits}".encode() for sign in ("", "u") for bits in (8, 16, 32, 64)
}
"""MATLAB's classes of numbers; nothing where another program wrote the file."""


def load_mat73(path: Path) -> dict[str, Any]:
    """Return the variables: arrays as MATLAB shows them, structs as records; no objects or cells.

    Raise ImportRefused for an array beyond `MOST_BYTES`, or a damaged file.
    """
    try:
        return _read_variables(path)
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        fix = "save it again with save(name, ..., '-v7')"
        raise ImportRefused(
            f"{path} is a damaged MAT file of version 7.3: {error}; {fix}"
        ) from None


def _read_variables(path: Path) -> dict[str, Any]:
    with h5py.File(path, "r") as file:
        return {
            name: _read_node(path, file, file[name], 0)
            for name in file
            if not name.startswith("#") and isinstance(file.get(name, getlink=True), h5py.HardLink)
        }


def _read_node(path: Path, file: Any, node: Any, depth: int) -> Any:
    if depth > _DEEPEST:
        raise ImportRefused(f"{path}: {node.name} is nested too deeply")
    kind = node.attrs.get("MATLAB_class", b"")
    if isinstance(node, h5py.Group):
        return _read_struct(path, file, node, depth)
    if node.size * node.dtype.itemsize > MOST_BYTES:
        size = f"{node.size * node.dtype.itemsize / 2**30:.1f} GB"
        raise ImportRefused(f"{path}: {node.name} takes {size}; save it in parts")
    if "MATLAB_empty" in node.attrs:
        return None
    if kind == b"char":
        return np.array(["".join(map(chr, node[()].reshape(-1, order="F")))])
    if node.dtype.kind not in "fiub" or kind not in _NUMBERS:  # an object, a cell
        return None
    values = node[()]
    # MATLAB stores the columns one after the other: HDF5 shows the transposed array.
    return np.atleast_2d(values.T) if values.ndim else np.array([[values]])


def _read_struct(path: Path, file: Any, group: Any, depth: int) -> Any:
    """Return a struct, or an array of structs, as a record array of shape (1, n)."""
    fields = [name for name in group if not name.startswith("#")]
    if not fields:
        return None
    length = max((_count_elements(group[name]) for name in fields), default=1)
    records = np.empty((1, length), [(name, object) for name in fields])
    for name in fields:
        node = group[name]
        if _is_list(node):
            for index, reference in enumerate(node[()].reshape(-1)):
                records[name][0, index] = _read_node(path, file, file[reference], depth + 1)
        else:
            records[name][0, 0] = _read_node(path, file, node, depth + 1)
    return records


def _is_list(node: Any) -> bool:
    """Return whether a field has one value for each struct of an array: references to them."""
    return (
        isinstance(node, h5py.Dataset)
        and h5py.check_ref_dtype(node.dtype) is h5py.Reference
        and "MATLAB_class" not in node.attrs
    )


def _count_elements(node: Any) -> int:
    return int(node.size) if _is_list(node) else 1
