"""The index of a folder: a file of JSON lines beside the logs, made from them at any time again.

Whoever opens it compares it with the folder first: new and changed logs are read, logs that are
gone are forgotten. Rows are only added at its end, where the last one of a log counts: two
processes may do so at once, and what is lost or damaged is read from its log again. A folder that
cannot be written gets an index in memory.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from pamctl.exit_codes import ExitCode
from pamctl.log.annotation import Annotation
from pamctl.log.edit import read_annotation, write_annotation
from pamctl.new_file import NewFileError, describe_irregular_file, write_files
from pamctl.runs.index_finished import INDEX_NAME
from pamctl.runs.run_row import RunRow, read_row

_FORMAT = 3
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
