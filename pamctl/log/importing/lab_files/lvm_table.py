"""Read an LVM file, LabVIEW's text measurement, with its segments one after the other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lvm_read
import numpy as np

from pamctl.log.importing.measured_table import Floats, ImportRefused, MeasuredTable

X_NAME = "X_Value"
TIME = "time_s"
COMMENT = "Comment"


def parse_lvm(path: Path) -> MeasuredTable:
    """Return the channels and their time; raise ImportRefused if segments do not fit together."""
    # Its cache beside the file is a pickle, which may be anybody's.
    content = lvm_read.read(str(path), read_from_pickle=False, dump_file=False)
    segments = [content[index] for index in range(content["Segments"])]
    several = content.get("X_Columns") == "Multi"
    parts = [_read_segment(path, segment, several=several) for segment in segments]
    if any(part.keys() != parts[0].keys() for part in parts):
        raise ImportRefused(
            f"{path}: its segments have different channels; save one segment in a file"
        )
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if not columns or not len(next(iter(columns.values()))):
        raise ImportRefused(f"{path} holds no rows of numbers")
    longest = max(map(len, columns.values()))
    return MeasuredTable(columns, np.arange(1, longest + 1), units=_find_units(segments[0]))


def _read_segment(path: Path, segment: dict[str, Any], *, several: bool) -> dict[str, Floats]:
    names, table = segment["Channel names"], segment["data"]
    if table.ndim != 2 or table.shape[1] < len([n for n in names if n != COMMENT]):
        raise ImportRefused(f"{path} is not a complete LVM file: a row has too few values")
    columns: dict[str, Floats] = {}
    for index, name in enumerate(names):
        if name == COMMENT:
            continue
        if name == X_NAME:
            _add_time(path, segment, columns, table[:, index], several=several)
        elif name in columns:
            raise ImportRefused(f"{path} has more than one channel {name}; rename one")
        else:
            columns[name] = table[:, index]
    if TIME not in columns and _is_time(segment):
        columns = {TIME: _count_time(path, segment, len(table)), **columns}
    return columns


def _add_time(
    path: Path,
    segment: dict[str, Any],
    columns: dict[str, Floats],
    values: Floats,
    *,
    several: bool,
) -> None:
    """Keep the time of the rows; with a column of it for each channel, all must agree."""
    if not _is_time(segment):
        return
    finite = np.isfinite(values)
    if TIME not in columns:
        # LabVIEW may leave the column empty but for its interval.
        columns[TIME] = values if finite.all() else _count_time(path, segment, len(values))
    elif several and not np.array_equal(columns[TIME][finite], values[finite]):
        raise ImportRefused(f"{path}: its channels have different times; save them with one")


def _is_time(segment: dict[str, Any]) -> bool:
    return all(what in ("Time", "") for what in segment.get("X_Dimension", ["Time"]))


def _count_time(path: Path, segment: dict[str, Any], rows: int) -> Floats:
    steps = {float(step) for step in segment.get("Delta_X", []) if step == step}
    starts = {float(start) for start in segment.get("X0", [0.0]) if start == start}
    if len(steps) != 1 or len(starts) > 1:
        raise ImportRefused(f"{path} states no common interval (Delta_X) and no time of its rows")
    return np.asarray(min(starts, default=0.0) + steps.pop() * np.arange(rows), np.float64)


def _find_units(segment: dict[str, Any]) -> dict[str, str]:
    names = [name for name in segment["Channel names"] if name not in (X_NAME, COMMENT)]
    stated = segment.get("Y_Unit_Label", [])
    return {name: unit for name, unit in zip(names, stated, strict=False) if unit.strip()}
