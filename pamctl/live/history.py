"""The last half minute of a few columns, for the plots in the terminal."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping

from pamctl.live.braille import NOTHING, Extremes


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

    def bin_column(self, column: str, bins: int) -> list[Extremes]:
        """Return the smallest and the largest value in each of `bins` equal times.

        Not the mean: a peak that lasts a tick is what one looks for.
        """
        parts = [NOTHING] * bins
        if not self._ticks:
            return parts
        end_s = self._ticks[-1]["t_s"]
        for tick in self._ticks:
            value = tick[column]
            at = bins - 1 - int((end_s - tick["t_s"]) / self._seconds * bins)
            if at < 0 or math.isnan(value):
                continue
            low, high = parts[at]
            parts[at] = Extremes(
                value if math.isnan(low) else min(low, value),
                value if math.isnan(high) else max(high, value),
            )
        return parts
