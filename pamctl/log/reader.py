"""Read a log: the ticks as arrays by column, everything else as plain values.

A log of another version is read by the descriptor that it carries, or refused with the reason.
Every checksum in the file is verified.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from pamctl.log.contents import Contents
from pamctl.log.framing import (
    Damage,
    LogError,
    map_log_file,
    translate_parse_errors,
    unpack_chunk,
    verify_checksum,
    walk_records,
)
from pamctl.log.paging.grid_rows import GridRows
from pamctl.log.paging.pages import Pages
from pamctl.log.schema import (
    EVENT_TOPIC,
    GAINS_TOPIC,
    KEYFRAME_TOPIC,
    TICK_TOPIC,
    unit_of_column,
)
from pamctl.log.ticks import TickColumns, suggest_nearest
from pamctl.log.wire import UnknownLayout

__all__ = ["Log", "LogError", "NoSuchColumn", "read"]


class NoSuchColumn(LogError):
    """A log has no column of that name; the message gives the nearest name."""


@dataclass(frozen=True)
class Log:
    """A log: `log["position_m"]` is a column of its ticks, shape (n,).

    In memory a column is an array. `paging.read_paged` leaves the columns in the file.
    """

    path: Path
    columns: Mapping[str, NDArray[Any]]
    """The columns of the ticks, in the order of the log's own schema."""
    time_ns: NDArray[np.uint64]
    """Wall time of each tick."""
    units: Mapping[str, str]
    """The unit of each column."""
    events: list[dict[str, Any]]
    gains: list[dict[str, Any]]
    keyframes: list[dict[str, Any]]
    """Frozen states: `tick`, and the numbers of `state` by name."""
    config: dict[str, Any]
    """The resolved configuration of the run."""
    attachments: Mapping[str, bytes]
    metadata: Mapping[str, Mapping[str, str]]
    counts: Mapping[str, int]
    """Number of messages in the file, by topic."""
    is_imported: bool
    """Whether another system measured it: then it holds no controller to replay."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column; raise LogError with the nearest name if there is none."""
        if name in self.columns:
            return self.columns[name]
        raise NoSuchColumn(f"{self.path} has no column {name}{suggest_nearest(name, self.columns)}")

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.time_ns)

    @cached_property
    def grid(self) -> GridRows:
        """Which row holds which tick of the loop's grid."""
        if isinstance(self.columns, Pages):
            return self.columns.grid
        grid = GridRows()
        grid.take(self["tick"], self["missed"])
        return grid

    @property
    def t(self) -> NDArray[np.float64]:
        """Seconds since the first tick, shape (n,)."""
        return self["t_s"]


def read(path: str | Path, *topics: str, fields: Collection[str] | None = None) -> Log:
    """Read a log, or only these topics, or only these fields of the ticks.

    Raise LogError if any part of the file is damaged, also a part that is not asked for.
    """
    path = Path(path)
    contents, log = _read_fields(path, topics, fields)
    for name in fields or ():
        if contents.ticks is not None and name not in contents.ticks.none:
            near = suggest_nearest(name, contents.ticks.none)
            raise NoSuchColumn(f"{path} has no column {name}{near}")
    return log


def read_some(path: str | Path, fields: Collection[str], *topics: str) -> Log:
    """Read only these fields of the ticks, without those that the log lacks, and these topics.

    Raise LogError as `read` does.

    A long log takes a fraction of the time and memory then.
    """
    return _read_fields(Path(path), topics, fields)[1]


def _read_fields(
    path: Path, topics: Collection[str], fields: Collection[str] | None
) -> tuple[Contents, Log]:
    ticks = TickColumns()
    contents = Contents(topics, ticks.take, fields)
    fill_contents(path, contents)
    known = contents.ticks.none if contents.ticks and contents.wants(TICK_TOPIC) else {}
    columns = ticks.columns({n: c for n, c in known.items() if fields is None or n in fields})
    return contents, build_log(path, contents, columns, ticks.times())


def fill_contents(path: Path, contents: Contents) -> None:
    """Fill `contents` from a whole log; raise LogError if any part of the file is damaged."""
    damage = scan_log(path, contents)
    if damage is not None and damage.offset == 0:
        raise LogError(f"{path} is not a log: {damage}")
    if damage is not None:
        raise LogError(
            f"{path} is damaged: {damage}; "
            f"save the undamaged part with `pamctl log recover {path} DESTINATION`"
        )
    if contents.wants(TICK_TOPIC) and contents.ticks is None:
        raise LogError(f"{path} is not a log of pamctl: it has no channel {TICK_TOPIC}")


def scan_log(path: Path, contents: Contents) -> Damage | None:
    """Fill `contents` up to the first damage of a file; return that damage, None if there is none.

    Raise LogError if the file does not exist, or is of a version that cannot be read.
    """
    try:
        return _take_records(contents, map_log_file(path))
    except UnknownLayout as error:
        raise LogError(f"{path} was written by a version that cannot be read: {error}") from error


def _take_records(contents: Contents, file: memoryview) -> Damage | None:
    try:
        for record in walk_records(file):
            with translate_parse_errors(record):
                verify_checksum(file, record)
                if record.opcode == Opcode.CHUNK:
                    contents.inside(unpack_chunk(record), record.start)
                else:
                    contents.take(file[: record.end], record)
    except Damage as damage:
        return damage
    return None


def build_log(
    path: Path,
    contents: Contents,
    columns: Mapping[str, NDArray[Any]],
    time_ns: NDArray[np.uint64],
) -> Log:
    """Return the log of these columns, and of all else that `contents` has."""
    return Log(
        path=path,
        columns=columns,
        time_ns=time_ns,
        units={name: unit_of_column(name) for name in columns},
        events=contents.values[EVENT_TOPIC],
        gains=contents.values[GAINS_TOPIC],
        keyframes=contents.values[KEYFRAME_TOPIC],
        config=contents.config(),
        attachments=contents.attachments,
        metadata=contents.metadata,
        counts=dict(contents.counts),
        is_imported=contents.is_imported,
    )
