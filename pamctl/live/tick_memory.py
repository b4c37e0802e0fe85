"""The newest ticks of the run that is logged now: every tick, every column.

They are read from the ring in shared memory, as the recorder does. The loop does not notice: a
viewer copies rows, and its mapping cannot be written. The user of the daemon can read the ring,
and the group that may steer it; others cannot ask the daemon either.
"""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.base.texts import clean_document, from_json
from pamctl.recording.ring import Ring, RingError
from pamctl.recording.rows import RowKind, row_dtype


class TickShelf:
    """Rows of one type in one block of memory, which is used round and round.

    The system gives a page of memory when it is first written: a short run costs little.
    """

    def __init__(self, row: np.dtype[Any], most_bytes: int) -> None:
        """Hold as many rows as fit into `most_bytes`; each has a column `tick`, which rises."""
        self._rows: NDArray[Any] = np.empty(max(1, most_bytes // row.itemsize), row)
        self._put = 0
        """Number of rows put so far; row k lies at k modulo the room."""

    def put(self, ticks: NDArray[Any]) -> bool:
        """Copy ticks, shape (n,); return whether there was room for all without losing any."""
        room = len(self._rows)
        newest = ticks[-room:]
        start = (self._put + len(ticks) - len(newest)) % room
        until_end = min(len(newest), room - start)
        self._rows[start : start + until_end] = newest[:until_end]
        self._rows[: len(newest) - until_end] = newest[until_end:]
        self._put += len(ticks)
        return self._put <= room

    def limits(self) -> tuple[int, int]:
        """Return the first and the last tick; the last is below the first if there is none."""
        if not self._put:
            return 0, -1
        return self._number(self._oldest), self._number(self._put - 1)

    def read_columns(
        self, names: Sequence[str], first_tick: int, last_tick: int, every: int = 1
    ) -> Mapping[str, NDArray[np.float64]]:
        """Return columns of every `every`th tick from `first_tick` to `last_tick`, both included.

        Raises KeyError for a column that there is not.
        """
        known = self._rows.dtype.names or ()
        unknown = [name for name in names if name not in known]
        if unknown and self._put:
            raise KeyError(unknown[0])
        numbers = range(self._oldest, self._put)
        first = self._oldest + bisect_left(numbers, first_tick, key=self._number)
        end = self._oldest + bisect_right(numbers, last_tick, key=self._number)
        if not self._put:
            return {name: np.empty(0) for name in names}
        at = np.arange(first, end, every) % len(self._rows)
        return {name: self._rows[name][at].astype(float) for name in names}

    @property
    def _oldest(self) -> int:
        return max(0, self._put - len(self._rows))

    def _number(self, row: int) -> int:
        return int(self._rows["tick"][row % len(self._rows)])


MOST_BYTES = 352 << 20
"""A tick has some 275 bytes: this holds 22 minutes at 1 kHz, or 130 s at 10 kHz."""
_MOST_EVENTS = 500


class MemoryState(NamedTuple):
    """What the memory holds."""

    log: str
    """Name of the run's log; empty before the first run."""
    first_tick: int
    last_tick: int
    """The limits of what is kept; the last is below the first if nothing is."""
    is_complete: bool
    """The run goes on, or all of it is kept: its file has nothing more to offer now."""
    unseen: int
    """Rows that were overwritten before they were read here; the log has them."""
    problem: str
    """Why no ticks come; empty if all is well."""


class TickMemory:
    """Follows the ring of the current run. One thread follows, any thread asks."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        """Hold at most `most_bytes` of ticks; the oldest are dropped."""
        self._lock = threading.Lock()
        self._most_bytes = most_bytes
        self._ring: Ring | None = None
        self._row = 0
        self._log = ""
        self._problem = ""
        self._ticks = TickShelf(np.dtype([("tick", "<i8")]), most_bytes)
        self._is_whole = True
        self._unseen = 0
        self._events: deque[dict[str, Any]] = deque(maxlen=_MOST_EVENTS)

    def follow(self, ring: str | None, log: str | None) -> None:
        """Take what is new; `ring` and `log` are the paths of the current run, None without one.

        The ticks of a run that has ended stay until the next run begins.
        """
        if self._ring is not None:
            self._take_new_rows(self._ring)  # the last rows of a run that has just ended too
            if ring == str(self._ring.path):
                return
            self.close()
        if ring is not None and log is not None:
            self._attach(Path(ring), Path(log).name)

    def _attach(self, path: Path, log: str) -> None:
        try:
            ring = Ring.watch(path)
        except RingError as error:
            self._problem = "" if not path.exists() else _explain_problem(error)
            return
        with self._lock:
            self._ring, self._row = ring, 0
            self._log, self._problem = log, ""
            self._is_whole, self._unseen = True, 0
            self._events.clear()
            self._dtype = row_dtype(ring.meta.tick_fields)
            self._ticks = TickShelf(self._dtype["columns"], self._most_bytes)
        self._take_new_rows(ring)

    def _take_new_rows(self, ring: Ring) -> None:
        batch = ring.copy_recent(self._row)
        missed = batch.first_row - self._row
        is_first, self._row = self._row == 0, batch.end_row
        rows = np.frombuffer(batch.data, self._dtype)
        ticks = rows["columns"][rows["kind"] == RowKind.TICK]  # a copy, without the row's rest
        events = [
            {**clean_document(from_json(entry.payload)), "tick": entry.tick}
            for entry in (
                batch.entry(int(at)) for at in np.flatnonzero(rows["kind"] == RowKind.EVENT)
            )
        ]
        with self._lock:
            self._is_whole = self._is_whole and not missed
            self._unseen += 0 if is_first else missed
            self._events.extend(events)
            self._is_whole = self._ticks.put(ticks) and self._is_whole

    def close(self) -> None:
        """Leave the ring; what was taken stays."""
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    def is_following(self, log: str) -> bool:
        """Tell whether the run of this log goes on."""
        with self._lock:
            return self._ring is not None and log == self._log

    def state(self) -> MemoryState:
        """Return what is held."""
        with self._lock:
            is_complete = self._ring is not None or self._is_whole
            first, last = self._ticks.limits()
            return MemoryState(self._log, first, last, is_complete, self._unseen, self._problem)

    def events(self) -> list[dict[str, Any]]:
        """Return the newest events of the run, oldest first, each with its `tick`."""
        with self._lock:
            return list(self._events)

    def read_columns(
        self, names: Sequence[str], first_tick: int, last_tick: int, every: int = 1
    ) -> Mapping[str, NDArray[np.float64]]:
        """Return columns of every `every`th tick from `first_tick` to `last_tick`, both included.

        Raises KeyError for a column that the run does not have.
        """
        with self._lock:
            return self._ticks.read_columns(names, first_tick, last_tick, every)


def _explain_problem(error: RingError) -> str:
    if isinstance(error.__cause__, PermissionError):
        return (
            "only the user of the daemon and its group can see every tick: start the daemon with "
            "--group, or open the log when the run is over"
        )
    return str(error)
