"""The columns of a log: in memory, or left in the file and decoded where they are read."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.log.wire import TickBatch

WALL_TIME = "/time_ns"
"""Name of the wall times beside the columns of a page."""
_GROWN_TICKS = 1 << 18

Page = Mapping[str, NDArray[Any]]


class TickColumns:
    """Collects batches into whole columns.

    Each column is one piece of memory that grows in place: an hour's ticks are never held twice.
    """

    def __init__(self, none: Page, room: int = 0) -> None:
        """`none` has the columns without ticks, each of its type; `room` is for so many ticks."""
        kinds = {WALL_TIME: np.dtype(np.uint64), **{name: c.dtype for name, c in none.items()}}
        self._columns = {name: np.empty(room, kind) for name, kind in kinds.items()}
        self._count, self._room = 0, room

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return sum(column.nbytes for column in self._columns.values())

    def take(self, batch: TickBatch) -> None:
        """Add a batch."""
        begin, self._count = self._count, self._count + len(batch.log_time_ns)
        if self._count > self._room:
            self._resize(max(self._count, self._room + min(max(self._room, 4096), _GROWN_TICKS)))
        for name, values in {WALL_TIME: batch.log_time_ns, **batch.columns}.items():
            self._columns[name][begin : self._count] = values

    def finish(self) -> dict[str, NDArray[Any]]:
        """Return the columns, and the wall times under the name `WALL_TIME`."""
        self._resize(self._count)
        return self._columns

    def _resize(self, ticks: int) -> None:
        if ticks == self._room:
            return
        self._room = ticks
        for column in self._columns.values():
            column.resize(ticks, refcheck=False)


class GridRows:
    """Which row of a log holds which tick of the loop's grid.

    It remembers only where the grid is broken: ticks in a row need no memory of their own.
    """

    def __init__(self) -> None:
        """Begin without ticks."""
        self.count = 0
        """Number of rows."""
        self.is_rising = True
        """Every tick is later than the one before it, by its number and by its time."""
        self.losses: set[int] = set()
        """Rows with a loss before them: the run did not miss those ticks, but the log lost them."""
        self.missed_first = 0
        """Ticks that the run missed before the first row."""
        self.gaps = self.skipped = 0
        """Gaps between rows, and the ticks that are not there in all of them."""
        self.first_t_s, self.last_t_s = 0.0, -np.inf
        self._last_tick = 0
        self._rows: list[int] = []
        self._ticks: list[int] = []

    def take(
        self, tick: NDArray[np.int64], missed: NDArray[np.int64], t_s: NDArray[np.float64]
    ) -> None:
        """Add the next rows; the arrays have shape (n,)."""
        if not len(tick):
            return
        if self.count == 0:
            self.missed_first, self.first_t_s = int(missed[0]), float(t_s[0])
            self._begin_run(0, int(tick[0]))
            self._last_tick = int(tick[0]) - 1 - self.missed_first
        steps = np.diff(tick, prepend=self._last_tick)
        for at in np.flatnonzero((steps != 1) | (missed != 0)).tolist():
            row, step = self.count + at, int(steps[at])
            self.is_rising &= step > 0
            if step - 1 != int(missed[at]):
                self.losses.add(row)
            if step != 1 and row:
                self._begin_run(row, int(tick[at]))
                self.gaps += step > 1
                self.skipped += max(step - 1, 0)
        self.count += len(tick)
        with np.errstate(invalid="ignore"):  # a time may be infinite
            self.is_rising &= bool((np.diff(t_s, prepend=self.last_t_s) > 0.0).all())
        self._last_tick, self.last_t_s = int(tick[-1]), float(t_s[-1])

    def _begin_run(self, row: int, tick: int) -> None:
        self._rows.append(row)
        self._ticks.append(tick)

    @property
    def first_tick(self) -> int:
        """The tick of the first row."""
        return self._ticks[0]

    def find(self, tick: int) -> int | None:
        """Return the row of a tick; None if the log has no such tick."""
        row = self.find_from(tick)
        return row if self.find_from(tick + 1) > row else None

    def find_from(self, tick: int) -> int:
        """Return the row of the first tick that is not before this one."""
        run = bisect_right(self._ticks, tick) - 1
        if run < 0:
            return 0
        ends = self._rows[run + 1] if run + 1 < len(self._rows) else self.count
        return min(self._rows[run] + tick - self._ticks[run], ends)


PAGE_TICKS = 1 << 13
"""Ticks that are decoded together: some megabytes."""
_KEPT_PAGES = 3


class Pages(Mapping[str, Any]):
    """The columns of a log that stays in its file: `column[i]`, `column[a:b]`, `np.asarray`."""

    def __init__(
        self,
        none: Page,
        places: Sequence[tuple[int, int]],
        grid: GridRows,
        decode: Callable[[Sequence[int], int], Page],
    ) -> None:
        """`places` has the first row and the place of each chunk.

        `decode` reads such chunks with so many rows.

        `none` has the columns without ticks, each of its type.
        """
        self.grid = grid
        """Which row holds which tick."""
        self._none = none
        self._rows: list[int] = []
        """The first row of each page."""
        chunks: list[list[int]] = []
        for row, at in places:
            if not self._rows or row - self._rows[-1] >= PAGE_TICKS:
                self._rows.append(row)
                chunks.append([])
            chunks[-1].append(at)
        self._ends = ends = [*self._rows[1:], grid.count]
        starts = self._rows
        self._read = lru_cache(_KEPT_PAGES)(
            lambda number: decode(chunks[number], ends[number] - starts[number])
        )

    def __getitem__(self, name: str) -> PagedColumn:
        return PagedColumn(self, name, self._none[name].dtype)

    def __iter__(self) -> Iterator[str]:
        return iter(self._none)

    def __len__(self) -> int:
        return len(self._none)

    @property
    def time_ns(self) -> Any:
        """The wall time of each tick."""
        return PagedColumn(self, WALL_TIME, np.dtype(np.uint64))

    def cut(self, begin: int, end: int) -> Iterator[tuple[Page, slice]]:
        """Yield the pages that hold some rows, with the place of those rows in each."""
        while begin < end:
            number = bisect_right(self._rows, begin) - 1
            first, last = self._rows[number], self._ends[number]
            yield self._read(number), slice(begin - first, min(end, last) - first)
            begin = last


class PagedColumn:
    """One column. To read all of it at once takes as long as to read the log."""

    def __init__(self, pages: Pages, name: str, dtype: np.dtype[Any]) -> None:
        """Read the column `name` of `pages`."""
        self._pages, self._name = pages, name
        self.dtype = dtype

    def __len__(self) -> int:
        return self._pages.grid.count

    def __getitem__(self, at: int | slice) -> Any:
        """Return one value, or the values of a slice without gaps as an array."""
        if not isinstance(at, slice):
            row = range(len(self))[at]
            return self[row : row + 1][0]
        begin, end, step = at.indices(len(self))
        assert step == 1, "a slice without gaps"
        parts = [page[self._name][where] for page, where in self._pages.cut(begin, end)]
        return parts[0] if len(parts) == 1 else np.concatenate([np.empty(0, self.dtype), *parts])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the whole column."""
        whole: NDArray[Any] = np.asarray(self[:], dtype)
        return whole
