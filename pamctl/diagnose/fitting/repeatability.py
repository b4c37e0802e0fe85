"""How well the rig repeats itself, where the records ask the same of it again.

No model can explain what is different each time. Of two runs with the same past the residuals
of any model differ by that, and by the sensors' noise; what the model lacks is in both alike.

In closed loop the same reference brings about commands that are nearly the same. Each run is
simulated under its own; and what these differences do to the simulation is taken off, as if the
model were wrong about all of it: a loop that hunts tells nothing then, rather than too much.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.measured.record import Array, Record
from pamctl.plant.model import PlantSettings

PAST_S = 3.0
"""The same past within a record; across records it is the same from the vented rest on."""
LEAST_S = 2.0
"""Shorter repeats tell nothing."""
PIECE_S = 0.5
"""Differences are counted as one over so long."""
MOVES_V = 0.5
"""A valve that is held repeats itself by doing nothing."""
SAME_M = 1e-6
"""References that differ by less, a third of a count of the encoder, ask the same."""


class Repeat(NamedTuple):
    """Samples [start, start + length) of one record and [again, ...) of another, or the same."""

    one: int
    start: int
    other: int
    again: int
    length: int
    by_reference: bool = False
    """The same position was asked for; the commands are the loop's."""


class RepeatSpread(NamedTuple):
    """By how much a block does not repeat itself."""

    rms: float
    """In deviations of its sensor, whose noise is in it; 0 where nothing is repeated."""
    uncertainty: float
    """Of what is not the sensor's, relative, one sigma."""


UNKNOWN = RepeatSpread(0.0, 0.0)


def find_repeats(records: Sequence[Record]) -> tuple[Repeat, ...]:
    """Find where different runs, or different parts of a run, are asked the same.

    By their commands; where these differ, by their references.
    """
    known = [(i, r) for i, r in enumerate(records) if r.valve_v is not None]
    across = [found for a, b in combinations(known, 2) for found in _find_across_runs(a, b)]
    return (*across, *(found for i, r in known for found in _find_within_run(i, r)))


def _find_across_runs(a: tuple[int, Record], b: tuple[int, Record]) -> Iterator[Repeat]:
    (one, first), (other, second) = a, b
    size = min(len(first), len(second))
    same_grid = abs(first.period_s - second.period_s) < 1e-3 * first.period_s
    if first is second or not same_grid:
        return
    for by_reference in (False, True):
        asked, again = _demand_of(first, by_reference), _demand_of(second, by_reference)
        if asked is None or again is None:
            continue
        differs = _find_differences(asked[:size], again[:size], by_reference)
        length = int(np.argmax(differs)) if differs.any() else size
        if _is_telling(first, 0, length):
            yield Repeat(one, 0, other, 0, length, by_reference)
            return


def _demand_of(record: Record, by_reference: bool) -> Array | None:
    return record.reference_m if by_reference else record.valve_v


def _find_differences(one: Array, other: Array, by_reference: bool) -> NDArray[np.bool_]:
    """Tell where two stretches ask different things; of no reference nothing is known."""
    alike: NDArray[np.bool_] = np.abs(one - other) <= (SAME_M if by_reference else 0.0)
    return ~alike


def _find_within_run(index: int, record: Record) -> Iterator[Repeat]:
    """Find the longest stretch that comes again after some time, as periods do."""
    for by_reference in (False, True):
        asked = _demand_of(record, by_reference)
        best = None if asked is None else _find_longest(index, record, asked, by_reference)
        if best is not None:
            yield best
            return


def _find_longest(index: int, record: Record, asked: Array, by_reference: bool) -> Repeat | None:
    past = round(PAST_S / record.period_s)
    marks = _find_period_starts(asked, by_reference)
    best: Repeat | None = None
    for lag in sorted({int(lag) for lag in (marks[1:60] - marks[:1])}):
        differs = np.flatnonzero(_find_differences(asked[lag:], asked[:-lag], by_reference))
        edges = np.concatenate([[-1], differs, [len(asked) - lag]])
        longest = int(np.argmax(np.diff(edges)))
        start, stop = int(edges[longest]) + 1 + past, int(edges[longest + 1])
        if (best is None or stop - start > best.length) and _is_telling(
            record, start, stop - start
        ):
            best = Repeat(index, start, index, start + lag, stop - start, by_reference)
    return best


def _find_period_starts(asked: Array, by_reference: bool) -> NDArray[np.intp]:
    """Return where a period may begin: at jumps of a command, where a reference rises past half."""
    if not by_reference:
        return np.flatnonzero(np.abs(np.diff(asked)) > MOVES_V) + 1
    half = 0.5 * (np.nanmin(asked) + np.nanmax(asked))
    return np.flatnonzero((asked[:-1] < half) & (asked[1:] >= half)) + 1


def _is_telling(record: Record, start: int, length: int) -> bool:
    part = record["valve_v"][start : start + max(length, 0)]
    return length * record.period_s >= LEAST_S and float(np.ptp(part)) > MOVES_V


def measure_repeatability(
    drives: Sequence[Drive], settings: PlantSettings, found: Sequence[Repeat]
) -> RepeatSpread:
    """Return by how much a block does not repeat itself.

    `drives` are in the order of the records that the repeats were found in.
    """
    if not found:
        return UNKNOWN
    left: dict[int, Array] = {}
    simulated: dict[int, Array] = {}
    for index in {i for r in found for i in (r.one, r.other)}:
        drive = replace(drives[index], rows=None)
        simulated[index] = drive.simulate(settings)
        left[index] = drive.residual_of(simulated[index])
        simulated[index] /= drive.deviation
    differences = np.concatenate([_difference(left, r) for r in found])
    # Of equal commands all that differs in the simulation is what the rig did differently.
    asked = [_difference(simulated, r) for r in found if r.by_reference]
    moved = np.sum(np.concatenate(asked) ** 2) if asked else 0.0
    period_s = float(np.median(drives[found[0].one].step_s))
    pieces = max(len(differences) * period_s / PIECE_S, 1.0)
    beyond = max(float(np.sum(differences**2) - moved), 0.0)
    spread = float(np.sqrt(0.5 * beyond / len(differences)))
    return RepeatSpread(spread, 1.0 / float(np.sqrt(2.0 * pieces)))


def _difference(signals: Mapping[int, Array], repeat: Repeat) -> Array:
    """Return what differs between the two stretches of a repeat."""
    one = signals[repeat.one][repeat.start : repeat.start + repeat.length]
    other = signals[repeat.other][repeat.again : repeat.again + repeat.length]
    difference: Array = one - other
    return difference
