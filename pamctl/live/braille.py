"""Plots of dots for a terminal: a character of braille holds two columns of four dots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

BLANK = "\u2800"
DOTS_ACROSS, DOTS_DOWN = 2, 4
_DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
"""The bit of each dot, by column and by row from the top."""


class Extremes(NamedTuple):
    """The smallest and the largest value of a part of time; NaN where there is none."""

    low: float
    high: float


NOTHING = Extremes(math.nan, math.nan)


def find_bounds(parts: Sequence[Extremes]) -> Extremes:
    """Return the smallest and the largest value of all parts."""
    known = [part for part in parts if not math.isnan(part.low)]
    if not known:
        return NOTHING
    return Extremes(min(part.low for part in known), max(part.high for part in known))


def draw_dots(parts: Sequence[Extremes], lines: int) -> list[str]:
    """Draw a column of dots for each part, from its smallest to its largest value.

    Returns `lines` lines, the top one first. Neighbours touch, so a line has no holes; where a part
    has no value it is broken.
    """
    low, high = find_bounds(parts)
    rows = lines * DOTS_DOWN
    cells = [[0] * math.ceil(len(parts) / DOTS_ACROSS) for _ in range(lines)]
    before: range | None = None
    for at, part in enumerate(parts):
        if math.isnan(part.low):
            before = None
            continue
        own = range(_row(part.high, low, high, rows), _row(part.low, low, high, rows) + 1)
        for row in _touching(own, before):
            column, dot = divmod(at, DOTS_ACROSS)
            cells[row // DOTS_DOWN][column] |= _DOTS[dot][row % DOTS_DOWN]
        before = own
    return ["".join(chr(ord(BLANK) + bits) for bits in line) for line in cells]


def _row(value: float, low: float, high: float, rows: int) -> int:
    """Return the row of dots of a value, from the top; a constant lies in the middle."""
    share = (high - value) / (high - low) if high > low else 0.5
    return round(share * (rows - 1))


def _touching(own: range, before: range | None) -> range:
    """Extend a column of dots to the one before it."""
    if before is None:
        return own
    return range(min(own.start, before.stop), max(own.stop, before.start))
