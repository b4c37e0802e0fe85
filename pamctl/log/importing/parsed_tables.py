"""The formats that packages parse: TDMS, LVM, Excel, NPZ, Parquet, MAT and HDF5.

A MAT or HDF5 file may hold arrays, matrices, structs, and Simulink's "structure with time":

    position_m            an array, 1 x n or n x 1
    yout(:,2), yout(2,:)  a column of a matrix, a row of one that is wider than high
    run.position_m        a field of a struct
    scope.time, scope     a structure with time, and its one signal; scope(2) is its second

The label of a Simulink signal serves as its name if it states a quantity and a unit.
"""

from __future__ import annotations

import datetime as dt
import logging
import zipfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import Any

import numpy as np

from pamctl.log.importing.column_map import TextHints
from pamctl.log.importing.measured_table import (
    MOST_NUMBERS,
    TIME_S,
    Floats,
    ImportRefused,
    MeasuredTable,
    TableColumn,
    make_columns,
    refuse_bomb,
)
from pamctl.log.importing.table_rows import HEAD_ROWS, Row, TableBuilder, find_layout


def number_rows(columns: list[TableColumn], form: str, notes: list[str]) -> MeasuredTable:
    """Return the table of columns that have no lines: their rows count from 1."""
    longest = max((len(column.values) for column in columns), default=0)
    return MeasuredTable(columns, np.arange(1, longest + 1), form, notes)


# TDMS.


History = dict[str, list[tuple[int, dict[str, Any]]]]
"""By channel: the first value for which properties hold, and these properties."""


def parse_tdms(path: Path, hints: TextHints) -> MeasuredTable:
    """Return the channels; raise ImportRefused where a unit or a scale changes within one."""
    from nptdms import TdmsFile

    complaints = BufferingHandler(1000)
    complaints.setLevel(logging.WARNING)
    for name in ("nptdms.reader", "nptdms.tdms_segment"):
        logging.getLogger(name).addHandler(complaints)
    history = _record_properties()
    with TdmsFile.open(path) as file:
        channels = [channel for group in file.groups() for channel in group.channels()]
        count = sum(len(channel) for channel in channels)
        if count > MOST_NUMBERS:
            raise ImportRefused(f"{path} is too large: {count} values; cut it into parts")
        refuse_bomb(path, 8 * count)
        names = Counter(channel.name for channel in channels)
        columns: list[TableColumn] = []
        times: list[tuple[str, Floats]] = []
        for channel in channels:
            full = f"{channel.group_name}/{channel.name}"
            name = channel.name if names[channel.name] == 1 else full
            changes = history.get(channel.path, [])
            _refuse_changed_scale(path, name, changes)
            said = channel.properties
            unit = said.get("unit_string") or said.get("NI_UnitDescription") or ""
            columns += _make_typed(name, channel[:], str(unit).strip())
            length = len(columns[-1].values)
            if "wf_increment" in said and length and columns[-1].unit != "s":
                times.append((name, _follow_time(changes, length)))
    notes = [f"the file is damaged: {one.getMessage()}" for one in complaints.buffer[:3]]
    columns = _add_times(columns, times, notes)
    if not any(len(column.values) for column in columns):
        raise ImportRefused(f"{path} holds no channels of numbers")
    return number_rows(columns, "TDMS", notes)


def _record_properties() -> History:
    """Return what the package's reader will fill: it keeps only the last of the properties."""
    from nptdms.reader import TdmsReader

    history: History = {}
    begins: dict[str, int] = {}
    take_segment, take_properties = (
        TdmsReader._update_object_metadata,
        TdmsReader._update_object_properties,
    )

    def segment_with_begin(reader: Any, segment: Any) -> None:
        begins.update({path: it.num_values for path, it in reader.object_metadata.items()})
        take_segment(reader, segment)

    def properties_with_begin(reader: Any, found: Any) -> None:
        for path, properties in (found or {}).items():
            history.setdefault(path, []).append((begins.get(path, 0), dict(properties)))
        take_properties(reader, found)

    TdmsReader._update_object_metadata = segment_with_begin
    TdmsReader._update_object_properties = properties_with_begin
    return history


def _refuse_changed_scale(path: Path, name: str, changes: list[tuple[int, dict[str, Any]]]) -> None:
    before: dict[str, Any] = {}
    for begin, properties in changes:
        for key, value in properties.items():
            matters = key in ("unit_string", "NI_UnitDescription") or key.startswith("NI_Scal")
            if matters and begin and before.get(key, value) != value:
                raise ImportRefused(
                    f"{path}: {name} changes {key} from {before[key]!r} to {value!r} at value "
                    f"{begin + 1}; export the parts before and after it as files of their own"
                )
            before[key] = value


def _follow_time(changes: list[tuple[int, dict[str, Any]]], length: int) -> Floats:
    """Return the times of a waveform, shape (n,), in seconds from the first start.

    A segment that states another start begins there; the others go on where the last one ended.
    """
    t_s = np.zeros(length)
    step_s, begin_s = 0.0, 0.0
    first: Any = None
    before: Any = None
    for at, properties in changes:
        offset_s = float(properties.get("wf_start_offset", 0.0))
        start: Any = properties.get("wf_start_time")
        start = start.as_datetime64("ns") if hasattr(start, "as_datetime64") else start
        begin_s = t_s[at - 1] + step_s if at else offset_s
        step_s = float(properties.get("wf_increment", step_s))
        if start is not None:
            first = start if first is None else first
            if at and start != before:
                begin_s = float((start - first) / np.timedelta64(1, "ns")) * 1e-9 + offset_s
            before = start
        t_s[at:] = begin_s + step_s * np.arange(length - at)
    return t_s


def _add_times(
    columns: list[TableColumn], times: list[tuple[str, Floats]], notes: list[str]
) -> list[TableColumn]:
    """Put the times of the waveforms before the columns, each once."""
    each: list[tuple[str, Floats]] = []
    for name, t_s in times:
        is_new = not any(np.array_equal(t_s, one) for _, one in each)
        if len(t_s) > 1 and t_s[1] > t_s[0] and is_new:
            each.append((name, t_s))
    if len(each) > 1:
        listed = ", ".join(f"{name} {len(t)} every {t[1] - t[0]:g} s" for name, t in each[:5])
        notes.append(f"the waveforms differ in start, length or interval ({listed})")
        return [*(TableColumn(f"time of {name}", t_s) for name, t_s in each), *columns]
    return [*(TableColumn(TIME_S, t_s) for _, t_s in each), *columns]


# LVM.


def parse_lvm(path: Path, hints: TextHints) -> MeasuredTable:
    """Return the channels and their time; raise ImportRefused if segments do not fit together."""
    import lvm_read

    # Its cache beside the file is a pickle, which may be anybody's.
    try:
        content = lvm_read.read(str(path), read_from_pickle=False, dump_file=False)
    except KeyError as error:
        raise ImportRefused(
            f"{path} is not a complete LVM file: no line of names begins with X_Value; save what "
            "is below its head as a .txt of its own, names first"
        ) from error
    segments = [content[index] for index in range(content["Segments"])]
    parts = [_read_lvm_segment(path, segment) for segment in segments]
    units = [segment.get("Y_Unit_Label", []) for segment in segments]
    if any(part.keys() != parts[0].keys() for part in parts):
        raise ImportRefused(f"{path}: its segments have different channels; save each in a file")
    if any(unit != units[0] for unit in units):
        raise ImportRefused(f"{path}: a unit changes between segments; save each in a file")
    first_s = _find_lvm_start(segments[0])
    for part, segment in zip(parts[1:], segments[1:], strict=True):
        if TIME_S in part and part[TIME_S][0] < parts[0][TIME_S][-1]:
            # Each segment counts from its own start.
            part[TIME_S] = part[TIME_S] + (_find_lvm_start(segment) - first_s)
    joined = [(name, np.concatenate([part[name] for part in parts])) for name in parts[0]]
    notes = []
    stated, there = _count_lvm_rows(segments[-1])
    if there < stated:
        # The end of a row that was cut off is a number, too.
        joined = [(name, values[:-1]) for name, values in joined]
        notes = [f"its head states {stated} samples, and {there} are there: it was cut off, and "
                 "its last row, which may lack digits, is left out"]  # fmt: skip
    if not joined or not len(joined[0][1]):
        raise ImportRefused(f"{path} holds no rows of numbers")
    channels = [name for name in parts[0] if name != TIME_S]
    units_by_name = {name: unit.strip() for name, unit in zip(channels, units[0], strict=False)}
    return number_rows(make_columns(joined, units_by_name), "LVM", notes)


def _read_lvm_segment(path: Path, segment: dict[str, Any]) -> dict[str, Floats]:
    """Return the columns by name; the time comes first where the file has it or its interval."""
    names, table = segment["Channel names"], segment["data"]
    if table.ndim != 2 or table.shape[1] < len([n for n in names if n != "Comment"]):
        raise ImportRefused(f"{path} is not a complete LVM file: a row has too few values")
    columns = {n: table[:, at] for at, n in enumerate(names) if n not in ("X_Value", "Comment")}
    if len(columns) < sum(name not in ("X_Value", "Comment") for name in names):
        twice = next(name for name in names if name in columns and names.count(name) > 1)
        raise ImportRefused(f"{path} has more than one channel {twice}; rename one")
    if any(what not in ("Time", "") for what in segment.get("X_Dimension", [])):
        return columns
    times = [table[:, at] for at, name in enumerate(names) if name == "X_Value"]
    # LabVIEW may leave the column empty but for its interval.
    full = [t_s for t_s in times if np.isfinite(t_s).all()]
    if len(full) < max(len(times), 1):
        full.append(_count_lvm_time(path, segment, len(table)))
    if any(not np.array_equal(t_s, full[0]) for t_s in full):
        raise ImportRefused(f"{path}: its channels have different times; save them with one")
    return {TIME_S: full[0], **columns}


def _count_lvm_rows(segment: dict[str, Any]) -> tuple[int, int]:
    """Return the rows that a segment states, 0 if it does not, and those that are there."""
    stated = [int(float(count)) for count in segment.get("Samples", []) if count == count]
    return max(stated, default=0), len(segment["data"])


def _count_lvm_time(path: Path, segment: dict[str, Any], rows: int) -> Floats:
    steps = {float(step) for step in segment.get("Delta_X", []) if step == step}
    starts = {float(start) for start in segment.get("X0", [0.0]) if start == start}
    if len(steps) != 1 or len(starts) > 1:
        raise ImportRefused(f"{path} states no common interval (Delta_X) and no time of its rows")
    return np.asarray(min(starts, default=0.0) + steps.pop() * np.arange(rows), np.float64)


def _find_lvm_start(segment: dict[str, Any]) -> float:
    """Return the time of day at which a segment starts, with its date, in seconds."""
    date, time = (segment.get(key) or [""] for key in ("Date", "Time"))
    first = [value if isinstance(value, str) else value[0] for value in (date, time)]
    try:
        day = dt.datetime.strptime(first[0].replace("-", "/"), "%Y/%m/%d").toordinal()
        hour, minute, second = first[1].replace(",", ".").split(":")
    except ValueError:
        return 0.0
    return day * 86400.0 + int(hour) * 3600.0 + int(minute) * 60.0 + float(second)


# Excel.


def parse_excel(path: Path, hints: TextHints) -> MeasuredTable:
    """Return the table; raise ImportRefused if no sheet, or more than one, has rows of numbers."""
    from openpyxl import load_workbook

    _refuse_zip_bomb(path)
    book = load_workbook(path, read_only=True, data_only=True)
    heads = [list(islice(_read_sheet(sheet), HEAD_ROWS)) for sheet in book.worksheets]
    found = [
        (sheet, layout)
        for sheet, head in zip(book.worksheets, heads, strict=True)
        if (layout := find_layout(head)) is not None
    ]
    if len(found) != 1:
        there = ", ".join(sheet.title for sheet, _ in found) or "none"
        raise ImportRefused(
            f"{path}: one sheet must hold the measurement; with rows of numbers there are {there}; "
            "save that sheet as a file of its own"
        )
    sheet, layout = found[0]
    builder = TableBuilder(path, layout, hints)
    rows = islice(_read_sheet(sheet), layout.first, None)
    while block := list(islice(rows, 10_000)):
        builder.take_rows(block)
    return builder.finish(f"Excel, sheet {sheet.title}")


def _refuse_zip_bomb(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        refuse_bomb(path, sum(part.file_size for part in archive.infolist()))


def _read_sheet(sheet: Any) -> Iterator[Any]:
    """Return the rows that are not empty, all as wide as the widest so far."""
    width = 0
    for number, values in enumerate(sheet.iter_rows(values_only=True), 1):
        cells = [_read_cell(value) for value in values]
        while cells and cells[-1] == "":
            cells.pop()
        width = max(width, len(cells))
        if cells:
            yield Row(number, cells + [""] * (width - len(cells)))


def _read_cell(value: Any) -> str | float:
    """Return a number as it is, and a time as a text that has all its digits."""
    if isinstance(value, (bool, int, float)):
        return float(value)
    if isinstance(value, dt.timedelta):
        hours, rest = divmod(value, dt.timedelta(hours=1))
        return f"{hours}:{(dt.datetime.min + rest).strftime('%M:%S.%f')}"
    if isinstance(value, dt.time):
        return value.strftime("%H:%M:%S.%f")
    if isinstance(value, dt.datetime):
        return value.isoformat(timespec="microseconds")
    return "" if value is None else str(value)


# Arrays.


def parse_npz(path: Path, hints: TextHints) -> MeasuredTable:
    """Return the arrays of an NPZ or NPY file; a structured one is taken apart."""
    if zipfile.is_zipfile(path):
        _refuse_zip_bomb(path)
    content = np.load(path, allow_pickle=False)
    arrays = dict(content) if hasattr(content, "files") else {path.stem: content}
    columns: list[TableColumn] = []
    for name, values in arrays.items():
        fields = values.dtype.names
        for field in fields or [None]:
            part = values[field] if field else values
            columns += _make_typed(str(field or name), part)
    return number_rows(columns, "NPZ", [])


def parse_parquet(path: Path, hints: TextHints) -> MeasuredTable:
    """Return the columns of a Parquet file."""
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        groups = [file.metadata.row_group(n) for n in range(file.metadata.num_row_groups)]
        refuse_bomb(path, sum(group.total_byte_size for group in groups))
        table = file.read()
    columns: list[TableColumn] = []
    for name, values in zip(table.column_names, table.columns, strict=True):
        columns += _make_typed(name, values.to_numpy())
    return number_rows(columns, "Parquet", [])


def _make_typed(name: str, values: Any, unit: str = "") -> list[TableColumn]:
    """Return the columns of an array of any type; times become seconds since the first one."""
    kind = values.dtype.kind
    if kind in "mM" and len(values):
        zero = values[:1] if kind == "M" else np.timedelta64(0, "ns")
        seconds = (values - zero).astype("timedelta64[ns]").astype(np.float64) * 1e-9
        seconds[np.isnat(values)] = np.nan
        return [TableColumn(name, seconds, "s", says="times, in seconds")]
    if kind not in "fiub":
        return [TableColumn(name, np.zeros(0), is_text=True)]
    return make_columns([(name, values)], {name: unit})


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
    elif "time" in fields and "data" in fields:
        yield TableColumn(f"{name}.time", _flatten(fields["time"]), called=TIME_S)
        yield TableColumn(name, _flatten(fields["data"]), called=_find_leaf(name))
    else:
        for field, value in struct.items():
            yield from _read_columns(f"{name}.{field}", value)


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


# HDF5 into what `loadmat` makes of older MAT files.


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
    return np.asarray(node[()]).T.squeeze() if is_matlab else np.asarray(node[()])


def _is_list(node: Any) -> bool:
    """Return whether a field has one value for each struct of an array: references to them."""
    import h5py

    return (
        isinstance(node, h5py.Dataset)
        and h5py.check_ref_dtype(node.dtype) is h5py.Reference
        and "MATLAB_class" not in node.attrs
    )
