"""How well the rig repeats itself, where the records give it the same commands again.

No model can explain what is different each time. Of two runs with the same past the residuals
of any model differ by that, and by the sensors' noise; what the model lacks is in both alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pamctl.diagnose.blocks import Drive
from pamctl.diagnose.records import Array, Record
from pamctl.plant.model import PlantSettings

PAST_S = 3.0
"""The same past within a record; across records it is the same from the vented rest on."""
LEAST_S = 2.0
"""Shorter repeats tell nothing."""
PIECE_S = 0.5
"""Differences are counted as one over so long."""
MOVES_V = 0.5
"""A valve that is held repeats itself by doing nothing."""


class Repeat(NamedTuple):
    """Samples [start, start + length) of one record and [again, ...) of another, or the same."""

    one: int
    start: int
    other: int
    again: int
    length: int


class Spread(NamedTuple):
    """By how much a block does not repeat itself."""

    rms: float
    """In deviations of its sensor, whose noise is in it; 0 where nothing is repeated."""
    uncertainty: float
    """Of what is not the sensor's, relative, one sigma."""


UNKNOWN = Spread(0.0, 0.0)


def repeats(records: Sequence[Record]) -> tuple[Repeat, ...]:
    """Find where different runs, or different parts of a run, have the same commands."""
    known = [(i, r) for i, r in enumerate(records) if r.valve_v is not None]
    across = [found for a, b in combinations(known, 2) for found in _from_the_start(a, b)]
    return (*across, *(found for i, r in known for found in _within(i, r)))


def _from_the_start(a: tuple[int, Record], b: tuple[int, Record]) -> Iterator[Repeat]:
    (one, first), (other, second) = a, b
    size = min(len(first), len(second))
    same_grid = abs(first.period_s - second.period_s) < 1e-3 * first.period_s
    if first is second or not same_grid:
        return
    differs = first["valve_v"][:size] != second["valve_v"][:size]
    length = int(np.argmax(differs)) if differs.any() else size
    if _tells(first, 0, length):
        yield Repeat(one, 0, other, 0, length)


def _within(index: int, record: Record) -> Iterator[Repeat]:
    """Find the longest stretch that comes again after some time, as periods do."""
    command = record["valve_v"]
    past = round(PAST_S / record.period_s)
    jumps = np.flatnonzero(np.abs(np.diff(command)) > MOVES_V) + 1
    best: Repeat | None = None
    for lag in sorted({int(lag) for lag in (jumps[1:60] - jumps[:1])}):
        differs = np.flatnonzero(command[lag:] != command[:-lag])
        edges = np.concatenate([[-1], differs, [len(command) - lag]])
        longest = int(np.argmax(np.diff(edges)))
        start, stop = int(edges[longest]) + 1 + past, int(edges[longest + 1])
        if (best is None or stop - start > best.length) and _tells(record, start, stop - start):
            best = Repeat(index, start, index, start + lag, stop - start)
    if best is not None:
        yield best


def _tells(record: Record, start: int, length: int) -> bool:
    part = record["valve_v"][start : start + max(length, 0)]
    return length * record.period_s >= LEAST_S and float(np.ptp(part)) > MOVES_V


def repeatability(
    drives: Sequence[Drive], settings: PlantSettings, found: Sequence[Repeat]
) -> Spread:
    """Return by how much a block does not repeat itself.

    `drives` are in the order of the records that the repeats were found in.
    """
    if not found:
        return UNKNOWN
    left: dict[int, Array] = {}
    for index in {i for r in found for i in (r.one, r.other)}:
        left[index] = replace(drives[index], rows=None).residual(settings)
    differences = np.concatenate(
        [
            left[r.one][r.start : r.start + r.length] - left[r.other][r.again : r.again + r.length]
            for r in found
        ]
    )
    period_s = float(np.median(drives[found[0].one].step_s))
    pieces = max(len(differences) * period_s / PIECE_S, 1.0)
    spread = float(np.sqrt(0.5 * np.mean(differences**2)))
    return Spread(spread, 1.0 / float(np.sqrt(2.0 * pieces)))
