"""The formats that packages parse: TDMS, LVM, Excel, NPZ and Parquet."""

from __future__ import annotations

import datetime as dt
import logging
import zipfile
from collections import Counter
from collections.abc import Iterator
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
    number_rows,
    refuse_bomb,
)
from pamctl.log.importing.table_rows import HEAD_ROWS, Row, TableBuilder, find_layout

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
