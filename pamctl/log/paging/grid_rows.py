"""Which row of a log holds which tick of the loop's grid."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray


class GridRows:
    """Remembers only where the grid is broken: ticks in a row need no memory of their own."""

    def __init__(self) -> None:
        """Begin without ticks."""
        self.count = 0
        """Number of rows."""
        self.is_rising = True
        """Every tick is later than the one before it."""
        self.losses: set[int] = set()
        """Rows with a loss before them: the run did not miss those ticks, but the log lost them."""
        self.missed_first = 0
        """Ticks that the run missed before the first row."""
        self._last_tick = 0
        self._rows: list[int] = []
        self._ticks: list[int] = []

    def take(self, tick: NDArray[np.int64], missed: NDArray[np.int64]) -> None:
        """Add the next rows; both arrays have shape (n,)."""
        if not len(tick):
            return
        if self.count == 0:
            self.missed_first = int(missed[0])
            self._begin_run(0, int(tick[0]))
            self._last_tick = int(tick[0]) - 1 - self.missed_first
        steps = np.diff(tick, prepend=self._last_tick)
        for at in np.flatnonzero((steps != 1) | (missed != 0)).tolist():
            self._step(self.count + at, int(steps[at]), int(missed[at]), int(tick[at]))
        self.count += len(tick)
        self._last_tick = int(tick[-1])

    def _step(self, row: int, step: int, missed: int, tick: int) -> None:
        self.is_rising &= step > 0
        if step - 1 != missed:
            self.losses.add(row)
        if step != 1 and row:
            self._begin_run(row, tick)

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
