"""Correction tables for errors that no known effect explains; they are not a cause.

    pull of the muscle (N)            over displacement and its load
    flow into the muscle (kg/s)       over the valve's opening and the pressure

The mass acts within 0.1 ms only, so displacement and load also determine the velocity. A table over
them can represent any missing force without memory. A model without tables does not compile them.
"""

from __future__ import annotations

from typing import NamedTuple


class CorrectionTable(NamedTuple):
    """Values on a grid: linear between its lines, constant beyond them."""

    first: tuple[float, ...]
    """Grid lines along the first axis, increasing."""
    second: tuple[float, ...]
    values: tuple[float, ...]
    """Row by row, with one row for each line of the first axis."""


class Correction(NamedTuple):
    """The tables of a plant; None adds nothing."""

    pull: CorrectionTable | None = None
    """N over displacement (m) and load: absolute pressure (Pa), or force (N) if direct."""
    flow: CorrectionTable | None = None
    """kg/s into the muscle over opening (V of command) and absolute pressure (Pa)."""


def interpolate_table(table: CorrectionTable | None, first: float, second: float) -> float:
    """Return the value of a table at a point; 0 without a table."""
    if table is None:
        return 0.0
    row, along = locate_on_grid(table.first, first)
    column, across = locate_on_grid(table.second, second)
    width = len(table.second)
    corner = row * width + column
    near = table.values[corner] + across * (table.values[corner + 1] - table.values[corner])
    corner += width
    far = table.values[corner] + across * (table.values[corner + 1] - table.values[corner])
    return near + along * (far - near)


def locate_on_grid(lines: tuple[float, ...], value: float) -> tuple[int, float]:
    """Return the index of the grid line before a value, and the share of the way to the next."""
    last = len(lines) - 2
    index = 0
    while index < last and value >= lines[index + 1]:
        index += 1
    share = (value - lines[index]) / (lines[index + 1] - lines[index])
    return index, min(max(share, 0.0), 1.0)
