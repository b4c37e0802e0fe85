"""Write the ticks of a log for other tools: CSV, MAT, Parquet.

Field names end with the unit in every format; all but CSV also store units apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.child import advise_install
from pamctl.base.errors import ExitCode
from pamctl.base.new_file import create_new_file, require_place
from pamctl.base.texts import escape_name
from pamctl.log.framing import LogError
from pamctl.log.reader import Log, NoSuchColumn, read
from pamctl.log.run_meta import flight_record_path
from pamctl.log.schema import TICK_TOPIC, unit_of_column

Columns = Mapping[str, NDArray[Any]]

_CSV_ROWS = 4096
FLIGHT_RECORD_S = 2.0


class ExportError(LogError):
    """The log cannot be exported in this way. The message says why, and what to do."""

    exit_code = ExitCode.USAGE


@dataclass(frozen=True)
class ExportSummary:
    """What an export wrote."""

    source: str
    destination: str
    ticks: int
    fields: tuple[str, ...]


def export_ticks(
    source: str | Path,
    destination: str | Path,
    *,
    fields: Sequence[str] | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    every: int = 1,
) -> ExportSummary:
    """Write every `every`-th tick with from_s <= t_s <= to_s into a new file.

    The suffix of the destination is the format. `fields` are the columns in this order; default:
    all. Raise ExportError if there is no such format or column, NewFileError if the destination
    cannot be written, LogError if the log cannot be read.
    """
    destination = Path(destination)
    write = _choose_writer(destination)
    require_place(destination)
    wanted = None if fields is None else {*fields, "t_s"}
    try:
        log = read(source, TICK_TOPIC, fields=wanted)
    except NoSuchColumn as error:
        raise ExportError(str(error)) from None
    kept = _select_ticks(log["t_s"], from_s, to_s, every)
    columns = {name: log[name][kept] for name in fields or log.columns}
    with create_new_file(destination) as stream:
        write(stream, columns, escape_name(Path(source).name))
    ticks = len(next(iter(columns.values())))
    return ExportSummary(str(source), str(destination), ticks, tuple(columns))


def dump_last_seconds(log: Log) -> Path:
    """Write the last two seconds of a log beside it as CSV; return its path.

    Raise NewFileError if that fails.
    """
    path = flight_record_path(log.path)
    first = int(log.t[:].searchsorted(log.t[-1] - FLIGHT_RECORD_S))
    with create_new_file(path, replaces="") as stream:
        _write_csv(stream, {name: log[name][first:] for name in log.columns}, "")
    return path


def _select_ticks(
    t_s: NDArray[np.float64], from_s: float | None, to_s: float | None, every: int
) -> slice:
    first = 0 if from_s is None else int(np.searchsorted(t_s, from_s, side="left"))
    last = len(t_s) if to_s is None else int(np.searchsorted(t_s, to_s, side="right"))
    if last <= first:
        span = f"the log is from {t_s[0]:g} s to {t_s[-1]:g} s" if len(t_s) else "the log has none"
        raise ExportError(f"there are no ticks to export there; {span}")
    return slice(first, last, every)


def _choose_writer(destination: Path) -> Callable[[BufferedWriter, Columns, str], None]:
    suffix = destination.suffix.lower()
    if suffix not in _WRITERS:
        known = ", ".join(_WRITERS)
        raise ExportError(f"{destination}: no such format {suffix!r}; there are {known}")
    if suffix == ".parquet":
        try:
            __import__("pyarrow")
        except ImportError:
            reason = f"Parquet needs the package pyarrow; {advise_install('pyarrow')}"
            raise ExportError(reason) from None
    return _WRITERS[suffix]


def _write_csv(stream: BufferedWriter, columns: Columns, source: str) -> None:
    """Write the shortest digits that read back to the same float; booleans as 1 and 0."""
    stream.write((",".join(columns) + "\r\n").encode())
    plain = [c.astype(np.int8) if c.dtype == np.bool_ else c for c in columns.values()]
    for start in range(0, len(plain[0]), _CSV_ROWS):
        cells = (map(repr, column[start : start + _CSV_ROWS].tolist()) for column in plain)
        rows = (",".join(row) for row in zip(*cells, strict=True))
        stream.write(("\r\n".join(rows) + "\r\n").encode())


def _write_mat(stream: BufferedWriter, columns: Columns, source: str) -> None:
    """Write `log.NAME`, columns of a struct, and `units.NAME`."""
    from scipy.io import savemat

    units = {name: unit_of_column(name) for name in columns}
    content = {"log": dict(columns), "units": units, "source": source}
    savemat(stream, content, long_field_names=True, do_compression=True, oned_as="column")


def _write_parquet(stream: BufferedWriter, columns: Columns, source: str) -> None:
    """Write each field with its unit as metadata, `unit`."""
    import pyarrow as pa
    from pyarrow import parquet

    fields = [
        pa.field(name, pa.from_numpy_dtype(column.dtype), metadata={"unit": unit_of_column(name)})
        for name, column in columns.items()
    ]
    schema = pa.schema(fields, metadata={"pamctl.source": source})
    table = pa.table([pa.array(column) for column in columns.values()], schema=schema)
    parquet.write_table(table, stream)


_WRITERS = {".csv": _write_csv, ".mat": _write_mat, ".parquet": _write_parquet}
