"""Room for the newest ticks, in the order of their numbers; the oldest give way."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
        room = len(self._rows)
        at, count = first % room, max(0, end - first)
        until_end = min(count, room - at)
        parts = (
            self._rows[at : at + until_end : every],
            self._rows[-until_end % every : count - until_end : every],
        )
        if not self._put:
            return {name: np.empty(0) for name in names}
        return {name: np.concatenate([part[name] for part in parts], dtype=float) for name in names}

    @property
    def _oldest(self) -> int:
        return max(0, self._put - len(self._rows))

    def _number(self, row: int) -> int:
        return int(self._rows["tick"][row % len(self._rows)])
