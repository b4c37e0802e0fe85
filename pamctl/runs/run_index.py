"""Runs found again: the index of a folder of logs, which runs are meant, and how they are listed.

The index is a file of JSON lines beside the logs, made from them at any time again. Whoever opens
it compares it with the folder first: new and changed logs are read, logs that are gone are
forgotten. Rows are only added at its end, where the last one of a log counts: two processes may do
so at once, and what is lost or damaged is read from its log again. A folder that cannot be written
gets an index in memory.
"""

from __future__ import annotations

import csv
import json
import operator
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from pamctl.base.errors import ExitCode
from pamctl.base.new_file import NewFileError, describe_irregular_file, write_files
from pamctl.base.texts import count_of, hint_at_nearest
from pamctl.log.edit import read_annotation, write_annotation
from pamctl.log.run_meta import Annotation
from pamctl.report.report import Report, ReportTable
from pamctl.runs.run_row import ENDING_WORDS, RunRow, find_varying_keys, read_row

INDEX_NAME = ".pamctl-runs.jsonl"
_FORMAT = 4
"""Counts up when rows change: rows of another format are made again."""
_BATCH = 200
"""Rows that are written together: what was read is kept if the reading is interrupted."""

Progress = Callable[[int, int], object]
"""Called with the number of logs that were read, and of those to read."""


class RunsError(Exception):
    """There are no runs to look at. The message says where, and what to do."""

    exit_code = ExitCode.USAGE


class RunIndex:
    """The index of one folder."""

    def __init__(self, folder: Path) -> None:
        """Read it, without a look at the logs. Raise RunsError if there is no folder."""
        if not folder.is_dir():
            raise RunsError(f"there is no folder of logs {folder}; name it with --logs")
        self.folder = folder
        self._rows: dict[str, RunRow] = {}
        self._file = folder / INDEX_NAME
        lines: list[bytes] = []
        if not describe_irregular_file(self._file):
            with suppress(OSError):
                lines = self._file.read_bytes().split(b"\n")
        for line in lines:
            with suppress(Exception):  # it is damaged, or no index at all
                row = _decode(line)
                self._rows[row.path] = row
        self._lines = len(lines)

    def count(self) -> int:
        """Return the number of logs."""
        return len(self._rows)

    def refresh(self, progress: Progress = lambda done, of: None, *, rebuild: bool = False) -> None:
        """Read the logs that are new or changed, or all; forget those that are gone."""
        there = dict(_list_logs(self.folder))
        self._rows = {path: row for path, row in self._rows.items() if path in there}
        known = {path: (row.size, row.mtime_ns) for path, row in self._rows.items()}
        stale = sorted(path for path, seen in there.items() if rebuild or known.get(path) != seen)
        for first in range(0, len(stale), _BATCH):
            rows = []
            for number, path in enumerate(stale[first : first + _BATCH], first + 1):
                with suppress(OSError):  # it has gone meanwhile
                    rows.append(read_row(self.folder / path))
                progress(number, len(stale))
            self.put(rows)
        if self._lines > 2 * len(self._rows) + _BATCH:
            with suppress(NewFileError):
                text = b"".join(map(_encode, self._rows.values()))
                write_files({self._file: text.decode()}, replaces="")

    def put(self, rows: Sequence[RunRow]) -> None:
        """Write rows, in the place of those of the same logs."""
        self._rows |= {row.path: row for row in rows}
        self._lines += len(rows)
        append_rows(self.folder, rows)

    def select(self) -> list[RunRow]:
        """Return all rows, the oldest first."""
        return sorted(self._rows.values(), key=lambda row: (row.when_s, row.path))


def append_rows(folder: Path, rows: Iterable[RunRow]) -> None:
    """Add rows to the index of a folder, if that can be written; they need not be new."""
    text = b"".join(map(_encode, rows))
    with suppress(OSError), (folder / INDEX_NAME).open("ab", buffering=0) as file:
        file.write(text)  # in one piece, behind what others write


def _list_logs(folder: Path) -> Iterator[tuple[str, tuple[int, int]]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            # A link would name a log of another folder; a pipe would never end.
            if entry.name.endswith(".mcap") and entry.is_file(follow_symlinks=False):
                with suppress(OSError):
                    stat = entry.stat(follow_symlinks=False)
                    yield entry.name, (stat.st_size, stat.st_mtime_ns)


def _encode(row: RunRow) -> bytes:
    # The line before may be cut off.
    return b"\n" + json.dumps({"format": _FORMAT, **vars(row)}).encode()


def _decode(line: bytes) -> RunRow:
    """Return the row of a line; raise whatever stands in the way if it is none."""
    said = json.loads(line)
    if said.pop("format", None) != _FORMAT:
        raise ValueError("another format")
    return RunRow(**{**said, "tags": tuple(said["tags"])})


@contextmanager
def _hold(folder: Path) -> Iterator[None]:
    """Keep other processes, by agreement, from changing notes in the logs of a folder."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network folders have no locks
            fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        os.close(number)


def edit_annotations(
    paths: Sequence[Path], edit: Callable[[Annotation], Annotation]
) -> list[tuple[Path, Annotation]]:
    """Change what is said of runs; return what is said of each now.

    Every log is read before the first one is written. Raise LogError where one is not a finished
    log, NewFileError where it cannot be written, AnnotationError where a text cannot be used.
    """
    for path in paths:
        edit(read_annotation(path))
    return [(path, _edit_one(path, edit)) for path in dict.fromkeys(paths)]


def _edit_one(path: Path, edit: Callable[[Annotation], Annotation]) -> Annotation:
    folder = path.absolute().parent
    with _hold(folder):
        before = read_annotation(path)
        said = edit(before)
        if said != before:
            write_annotation(path, said)
            append_rows(folder, [read_row(path)])
        return said


# --- which runs are meant ---------------------------------------------------------------------

_OPERATORS = {
    ">": operator.gt, "<": operator.lt, ">=": operator.ge, "<=": operator.le,
    "=": operator.eq, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip
_WHERE = re.compile(r"\s*([A-Za-z_][\w.-]*)\s*(>=|<=|!=|==|=|>|<)\s*(.*?)\s*")
_NUMBERS = [one.name for one in fields(RunRow) if str(one.type).startswith(("int", "float"))]
_TEXTS = [one.name for one in fields(RunRow) if one.type == "str"]


class FilterError(Exception):
    """An option that selects runs makes no sense. The message says what does."""

    exit_code = ExitCode.USAGE


@dataclass(frozen=True)
class RunFilter:
    """All that is given must hold."""

    tags: Sequence[str] = ()
    """All of them."""
    since_s: float | None = None
    """Seconds since the epoch."""
    where: Sequence[str] = ()
    """Conditions on columns and settings, such as `law=qsmc` or `controller.lambda_per_s>=40`."""
    last: int | None = None
    """Only the newest of them."""


def read_date(text: str) -> float:
    """Return a date such as `2026-11-20 14:30`, in the time zone of this PC, in epoch seconds.

    Raises FilterError.
    """
    try:
        return datetime.fromisoformat(text.strip()).timestamp()
    except (ValueError, OverflowError, OSError):
        message = f"--since {text!r}: write 2026-11-20 or '2026-11-20 14:30'"
        raise FilterError(message) from None


def select_runs(index: RunIndex, wanted: RunFilter) -> list[RunRow]:
    """Return the runs that are wanted, the oldest first; raise FilterError."""
    conditions = [_read_condition(text) for text in wanted.where]
    keys = [one.key for one in conditions if one.key not in (*_NUMBERS, *_TEXTS)]
    rows = index.select()
    for one in conditions:
        if one.key in keys and not any(one.key in row.gains for row in rows):
            known = {name for row in rows for name in row.gains}
            hint = hint_at_nearest(one.key, [*sorted(known), *_NUMBERS, *_TEXTS])
            raise FilterError(f"--where {one.text!r}: no run has {one.key}{hint}")
    kept = [
        row
        for row in rows
        if {*wanted.tags} <= {*row.tags}
        and (wanted.since_s is None or row.when_s >= wanted.since_s)
        and all(one.holds(row) for one in conditions)
    ]
    return kept[-wanted.last :] if wanted.last else kept


class _Condition(NamedTuple):
    """A key, a comparison and a value; `text` is how the user wrote it."""

    text: str
    key: str
    operator: str
    asked: str | float

    def holds(self, row: RunRow) -> bool:
        """Tell whether it is true of a run; it is not where the run does not have the key."""
        if self.key in _TEXTS:  # in any case; `*` stands for any part, only `*` and `?` are special
            pattern = str(self.asked).lower().replace("[", "[[]")
            is_alike = fnmatchcase(getattr(row, self.key).lower(), pattern)
            return is_alike == (self.operator != "!=")
        value = getattr(row, self.key) if self.key in _NUMBERS else row.gains.get(self.key)
        if value is None:
            return False
        if isinstance(value, str) != isinstance(self.asked, str):
            return self.operator == "!="
        return bool(_OPERATORS[self.operator](value, self.asked))


def _read_condition(text: str) -> _Condition:
    found = _WHERE.fullmatch(text)
    if not found or not found[3]:
        examples = "law=qsmc, 'rms_um<20' or 'controller.lambda_per_s>=40'"
        raise FilterError(f"--where {text!r}: write a key, a comparison and a value: {examples}")
    key, operator, asked = found.groups()
    is_equal = operator in ("=", "==", "!=")
    if key in _TEXTS:
        if not is_equal:
            raise FilterError(f"--where {text!r}: {key} is a text; compare it by = or !=")
        if key == "ending" and not {*asked} & {*"*?"} and asked not in ENDING_WORDS:
            raise FilterError(f"--where {text!r}: an ending is one of {', '.join(ENDING_WORDS)}")
        return _Condition(text, key, operator, asked)
    try:
        return _Condition(text, key, operator, float(asked))
    except ValueError:
        if not is_equal or key in _NUMBERS:
            raise FilterError(f"--where {text!r}: {asked!r} is no number") from None
        return _Condition(text, key, operator, asked)


_HEADER = (
    *("start", "law", "experiment", "ending", "s", "max, µm", "RMS, µm", "steady, µm"),
    "log  [tags] note",
)
_MOST_NOTE = 60


def report_runs(rows: Sequence[RunRow], total: int, folder: Path) -> Report:
    """Return a table, the newest run last, and how many of how many runs they are."""
    documents = [
        {"start": datetime.fromtimestamp(row.when_s, UTC).isoformat(), **vars(row)} for row in rows
    ]
    report = Report(
        f"Runs of {folder}",
        f"{len(rows)} of {count_of(total, 'run')}",
        document={"logs": str(folder), "runs": documents, "of": total},
    )
    return report.add(ReportTable(_HEADER, [*map(_make_cells, rows)])) if rows else report


def _make_cells(row: RunRow) -> list[str]:
    start = datetime.fromtimestamp(row.when_s).strftime("%Y-%m-%d %H:%M:%S")
    errors = ("-" if v is None else f"{v:.1f}" for v in (row.max_um, row.rms_um, row.steady_um))
    tags = f"  [{' '.join(row.tags)}]" if row.tags else ""
    note = row.note if len(row.note) <= _MOST_NOTE else f"{row.note[: _MOST_NOTE - 3]}..."
    log = f"{row.path}{tags}{'  ' + note if note else ''}"
    return [start, row.law, row.experiment, row.ending, f"{row.duration_s:.1f}", *errors, log]


def format_csv(rows: Sequence[RunRow]) -> str:
    """Return every column, and a column for each setting that differs between the runs."""
    varying = find_varying_keys(rows)
    plain = [one.name for one in fields(RunRow) if one.name != "gains"]
    text = StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["start", *plain, *varying])
    for row in rows:
        start = datetime.fromtimestamp(row.when_s, UTC).isoformat(timespec="milliseconds")
        values = (" ".join(row.tags) if name == "tags" else getattr(row, name) for name in plain)
        settings = (row.gains.get(key) for key in varying)
        table.writerow([start, *values, *settings])
    return text.getvalue().rstrip("\n")
