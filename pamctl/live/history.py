"""The last half minute of a few columns, for the plots in the terminal."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping

BLOCKS = "▁▂▃▄▅▆▇█"


class History:
    """Values by column, each with its time; old ones are dropped."""

    def __init__(self, seconds: float) -> None:
        """Keep the last `seconds`."""
        self._seconds = seconds
        self._ticks: deque[Mapping[str, float]] = deque()

    def extend(self, ticks: Iterable[Mapping[str, float]]) -> None:
        """Add new ticks. A time that goes back begins another session and drops the old values."""
        for tick in ticks:
            if self._ticks and tick["t_s"] < self._ticks[-1]["t_s"]:
                self._ticks.clear()
            self._ticks.append(tick)
        while self._ticks and self._ticks[-1]["t_s"] - self._ticks[0]["t_s"] > self._seconds:
            self._ticks.popleft()

    def bin_column(self, column: str, bins: int) -> list[float]:
        """Return the value of largest size in each of `bins` equal times; NaN where there is none.

        Not the mean: a peak that lasts a tick is what one looks for.
        """
        largest = [math.nan] * bins
        if not self._ticks:
            return largest
        end_s = self._ticks[-1]["t_s"]
        for tick in self._ticks:
            value = tick[column]
            at = bins - 1 - int((end_s - tick["t_s"]) / self._seconds * bins)
            if at >= 0 and not math.isnan(value) and not abs(largest[at]) >= abs(value):
                largest[at] = value
        return largest


def draw_sparkline(values: list[float]) -> tuple[str, float, float]:
    """Draw values as a line of blocks; return it with the smallest and the largest value.

    NaN is a blank; both bounds are NaN where there is nothing else.
    """
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return " " * len(values), math.nan, math.nan
    low, high = min(known), max(known)
    step = (high - low) / (len(BLOCKS) - 1)

    def block(value: float) -> str:
        if math.isnan(value):
            return " "
        return BLOCKS[round((value - low) / step)] if step > 0.0 else BLOCKS[0]

    return "".join(map(block, values)), low, high
