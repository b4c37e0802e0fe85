"""The index of a folder: a SQLite file beside the logs, made from them and made again at any time.

Whoever opens it compares it with the folder first: new and changed logs are read, logs that are
gone are forgotten. Two processes may do so at once; each row is written whole. A folder that
cannot be written gets an index in memory.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from pamctl.exit_codes import ExitCode
from pamctl.log.annotation import Annotation
from pamctl.log.edit import read_annotation, write_annotation
from pamctl.runs.index_finished import INDEX_NAME
from pamctl.runs.run_row import RunRow, read_row

_FORMAT = 2
"""Counts up when rows change: an index of another format is made again."""
_APPLICATION = 0x70616D63
"""Marks the file as an index of pamctl."""
_PATIENCE_S = 10.0
_BATCH = 200
"""Rows of a transaction while a folder is read: what was read is kept if that is interrupted."""

_COLUMNS = [one.name for one in fields(RunRow)]
_JSON = {"tags", "sweep", "gains"}
_TEXT_TYPES = {"int": "INTEGER", "float": "REAL", "int | None": "INTEGER", "float | None": "REAL"}
_TYPES = {one.name: _TEXT_TYPES.get(str(one.type), "TEXT") for one in fields(RunRow)}

Progress = Callable[[int, int], object]
"""Called with the number of logs that were read, and of those to read."""


class RunsError(Exception):
    """There are no runs to look at. The message says where, and what to do."""

    exit_code = ExitCode.USAGE


class RunIndex:
    """The index of one folder; a context manager."""

    def __init__(self, folder: Path) -> None:
        """Open or make it, without a look at the logs. Raise RunsError if there is no folder."""
        if not folder.is_dir():
            raise RunsError(f"there is no folder of logs {folder}; name it with --logs")
        self.folder = folder
        self._base = _open(folder / INDEX_NAME)

    def __enter__(self) -> RunIndex:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self._base.close()

    def count(self) -> int:
        """Return the number of logs."""
        ((count,),) = self._base.execute("SELECT count(*) FROM runs")
        return int(count)

    def refresh(self, progress: Progress = lambda done, of: None, *, rebuild: bool = False) -> None:
        """Read the logs that are new or changed, or all; forget those that are gone."""
        there = dict(_list_logs(self.folder))
        known = {
            os.fsdecode(path): (size, mtime_ns)
            for path, size, mtime_ns in self._base.execute("SELECT path, size, mtime_ns FROM runs")
        }
        gone = [(_encode_path(path),) for path in known.keys() - there.keys()]
        if gone:
            with self._writing() as base:
                base.executemany("DELETE FROM runs WHERE path = ?", gone)
        stale = sorted(path for path, seen in there.items() if rebuild or known.get(path) != seen)
        for first in range(0, len(stale), _BATCH):
            rows = []
            for number, path in enumerate(stale[first : first + _BATCH], first + 1):
                with suppress(OSError):  # it has gone meanwhile
                    rows.append(read_row(self.folder / path))
                progress(number, len(stale))
            self.put(rows)

    def put(self, rows: Sequence[RunRow]) -> None:
        """Write rows, in the place of those of the same logs."""
        marks = ", ".join("?" * len(_COLUMNS))
        with self._writing() as base:
            base.executemany(f"INSERT OR REPLACE INTO runs VALUES ({marks})", map(_encode, rows))

    def select(self, *, with_gains: bool = True) -> list[RunRow]:
        """Return all rows, the oldest first.

        Without gains, which most lists do not show, ten thousand rows take half the time.
        """
        names = ", ".join(n if with_gains or n != "gains" else "'{}'" for n in _COLUMNS)
        query = f"SELECT {names} FROM runs ORDER BY when_s, path"
        return [_decode(values) for values in self._base.execute(query)]

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Keep other processes from changing the index and, by agreement, notes in its logs."""
        with self._writing():
            yield

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        nested = self._base.in_transaction
        if not nested:
            self._base.execute("BEGIN IMMEDIATE")
        try:
            yield self._base
        except BaseException:
            if not nested:
                self._base.rollback()
            raise
        if not nested:
            self._base.commit()


def index_log(path: Path) -> None:
    """Put one finished log into the index of its folder; raise whatever stands in the way."""
    with RunIndex(path.absolute().parent) as index:
        index.put([read_row(path)])


def _list_logs(folder: Path) -> Iterator[tuple[str, tuple[int, int]]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            # A link would name a log of another folder; a pipe would never end.
            if entry.name.endswith(".mcap") and entry.is_file(follow_symlinks=False):
                with suppress(OSError):
                    stat = entry.stat(follow_symlinks=False)
                    yield entry.name, (stat.st_size, stat.st_mtime_ns)


def _open(path: Path) -> sqlite3.Connection:
    if path.exists() and not (os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)):
        return _copy_to_memory(path)
    try:
        return _connect(str(path))
    except sqlite3.OperationalError as error:
        if "locked" in str(error):
            raise RunsError(f"{path} is in use by another process; try again") from error
    except sqlite3.DatabaseError:  # damaged, or no index at all: the logs still say everything
        with suppress(OSError, sqlite3.Error):
            path.unlink()
            return _connect(str(path))
    return _connect(":memory:")


def _copy_to_memory(path: Path) -> sqlite3.Connection:
    """Return the index of another user, with changes that are not kept."""
    memory = sqlite3.connect(":memory:", isolation_level=None)
    with suppress(sqlite3.Error):
        file = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
        with closing(file):
            file.backup(memory)
            if _is_current(memory):
                return memory
    memory.close()
    return _connect(":memory:")


def _connect(name: str) -> sqlite3.Connection:
    base = sqlite3.connect(name, timeout=_PATIENCE_S, isolation_level=None)
    try:
        if _is_current(base):
            return base
        base.execute("BEGIN IMMEDIATE")
        if not _is_current(base):  # another process may have made it meanwhile
            columns = ", ".join(f"{name} {kind}" for name, kind in _TYPES.items())
            base.execute("DROP TABLE IF EXISTS runs")
            base.execute(f"CREATE TABLE runs ({columns}, PRIMARY KEY (path))")
            base.execute(f"PRAGMA user_version = {_FORMAT}")
            base.execute(f"PRAGMA application_id = {_APPLICATION}")
        base.execute("COMMIT")
        return base
    except BaseException:
        base.close()
        raise


def _is_current(base: sqlite3.Connection) -> bool:
    ((version,),) = base.execute("PRAGMA user_version")
    ((application,),) = base.execute("PRAGMA application_id")
    return (version, application) == (_FORMAT, _APPLICATION)


def _encode_path(path: str) -> str | bytes:
    """Return a file's name as SQLite takes it: its bytes where they are not UTF-8."""
    name = os.fsencode(path)
    return path if name.decode(errors="replace") == path else name


def _encode(row: RunRow) -> list[Any]:
    values = {**vars(row), "path": _encode_path(row.path)}
    return [json.dumps(values[n]) if n in _JSON else values[n] for n in _COLUMNS]


def _decode(values: Sequence[Any]) -> RunRow:
    named: Mapping[str, Any] = dict(zip(_COLUMNS, values, strict=True))
    read = {name: json.loads(named[name]) for name in _JSON}
    path, tags = os.fsdecode(named["path"]), tuple(read["tags"])
    return RunRow(**{**named, **read, "path": path, "tags": tags})


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
    with RunIndex(path.absolute().parent) as index, index.hold():
        before = read_annotation(path)
        said = edit(before)
        if said != before:
            write_annotation(path, said)
            index.put([read_row(path)])
        return said
