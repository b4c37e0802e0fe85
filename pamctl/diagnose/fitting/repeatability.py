"""How well the rig repeats itself, where the records demand the same of it again.

No model can explain what is different each time. For two runs with the same past, the residuals
of any model differ by that and by the sensors' noise; what the model lacks is the same in both.

In closed loop the same reference leads to nearly the same commands. Each run is simulated with its
own command. The effect of the differences on the simulation is then subtracted in full, as if the
model were wrong about all of it: a loop that hunts gives no information rather than a wrong one.
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
"""Equal past that a repeat within a record needs. Two records are equal from the vented rest on."""
LEAST_S = 2.0
"""Shorter repeats give no information."""
PIECE_S = 0.5
"""Differences within this time count as one."""
MOVES_V = 0.5
"""The command of a repeat must vary by more than this: a closed valve always repeats itself."""
SAME_M = 1e-6
"""References that differ by less, a third of an encoder count, are the same."""


class Repeat(NamedTuple):
    """Samples [start, start + length) of one record and [again, ...) of another, or the same."""

    one: int
    start: int
    other: int
    again: int
    length: int
    by_reference: bool = False
    """The references are equal; the commands come from the loop."""


class RepeatSpread(NamedTuple):
    """How far a block is from repeating itself."""

    rms: float
    """In deviations of its sensor, with the sensor's noise; 0 where nothing is repeated."""
    uncertainty: float
    """Relative uncertainty of the part that is not sensor noise, one sigma."""


UNKNOWN = RepeatSpread(0.0, 0.0)


def find_repeats(records: Sequence[Record]) -> tuple[Repeat, ...]:
    """Find where different runs, or different parts of a run, have the same demand.

    The demand is the command; where commands differ, the reference.
    """
    known = [(i, r) for i, r in enumerate(records) if r.valve_v is not None]
    across = [repeat for a, b in combinations(known, 2) for repeat in _find_across_runs(a, b)]
    return (*across, *(repeat for i, r in known for repeat in _find_within_run(i, r)))


def _find_across_runs(a: tuple[int, Record], b: tuple[int, Record]) -> Iterator[Repeat]:
    (one, first), (other, second) = a, b
    size = min(len(first), len(second))
    same_grid = abs(first.period_s - second.period_s) < 1e-3 * first.period_s
    if first is second or not same_grid:
        return
    for by_reference in (False, True):
        demand, again = _choose_demand(first, by_reference), _choose_demand(second, by_reference)
        if demand is None or again is None:
            continue
        differs = _find_differences(demand[:size], again[:size], by_reference)
        length = int(np.argmax(differs)) if differs.any() else size
        if _is_telling(first, 0, length):
            yield Repeat(one, 0, other, 0, length, by_reference)
            return


def _choose_demand(record: Record, by_reference: bool) -> Array | None:
    return record.reference_m if by_reference else record.valve_v


def _find_differences(one: Array, other: Array, by_reference: bool) -> NDArray[np.bool_]:
    """Tell where two demands differ; samples without a reference count as different."""
    alike: NDArray[np.bool_] = np.abs(one - other) <= (SAME_M if by_reference else 0.0)
    return ~alike


def _find_within_run(index: int, record: Record) -> Iterator[Repeat]:
    """Find the longest stretch that comes again after some time, as periods do."""
    for by_reference in (False, True):
        demand = _choose_demand(record, by_reference)
        best = None if demand is None else _find_longest(index, record, demand, by_reference)
        if best is not None:
            yield best
            return


def _find_longest(index: int, record: Record, demand: Array, by_reference: bool) -> Repeat | None:
    past = round(PAST_S / record.period_s)
    starts = _find_period_starts(demand, by_reference)
    best: Repeat | None = None
    for lag in sorted({int(lag) for lag in (starts[1:60] - starts[:1])}):
        differs = np.flatnonzero(_find_differences(demand[lag:], demand[:-lag], by_reference))
        edges = np.concatenate([[-1], differs, [len(demand) - lag]])
        longest = int(np.argmax(np.diff(edges)))
        start, stop = int(edges[longest]) + 1 + past, int(edges[longest + 1])
        if (best is None or stop - start > best.length) and _is_telling(
            record, start, stop - start
        ):
            best = Repeat(index, start, index, start + lag, stop - start, by_reference)
    return best


def _find_period_starts(demand: Array, by_reference: bool) -> NDArray[np.intp]:
    """Return where a period may begin: where a command jumps, or a reference rises past half."""
    if not by_reference:
        return np.flatnonzero(np.abs(np.diff(demand)) > MOVES_V) + 1
    half = 0.5 * (np.nanmin(demand) + np.nanmax(demand))
    return np.flatnonzero((demand[:-1] < half) & (demand[1:] >= half)) + 1


def _is_telling(record: Record, start: int, length: int) -> bool:
    part = record["valve_v"][start : start + max(length, 0)]
    return length * record.period_s >= LEAST_S and float(np.ptp(part)) > MOVES_V


def measure_repeatability(
    drives: Sequence[Drive], settings: PlantSettings, repeats: Sequence[Repeat]
) -> RepeatSpread:
    """Return how far a block is from repeating itself.

    `drives` are in the order of the records in which the repeats were found.
    """
    if not repeats:
        return UNKNOWN
    left: dict[int, Array] = {}
    simulated: dict[int, Array] = {}
    for index in {i for r in repeats for i in (r.one, r.other)}:
        drive = replace(drives[index], usable=None, part=None)
        simulated[index] = drive.simulate(settings)
        left[index] = drive.residual_of(simulated[index])
        simulated[index] /= drive.deviation
    differences = np.concatenate([_difference(left, r) for r in repeats])
    # With equal commands, simulated differences come from the rig and are not subtracted.
    simulated_differences = [_difference(simulated, r) for r in repeats if r.by_reference]
    explained = np.sum(np.concatenate(simulated_differences) ** 2) if simulated_differences else 0.0
    period_s = float(np.median(drives[repeats[0].one].step_s))
    pieces = max(len(differences) * period_s / PIECE_S, 1.0)
    beyond = max(float(np.sum(differences**2) - explained), 0.0)
    spread = float(np.sqrt(0.5 * beyond / len(differences)))
    return RepeatSpread(spread, 1.0 / float(np.sqrt(2.0 * pieces)))


def _difference(signals: Mapping[int, Array], repeat: Repeat) -> Array:
    """Return the difference between the two stretches of a repeat."""
    one = signals[repeat.one][repeat.start : repeat.start + repeat.length]
    other = signals[repeat.other][repeat.again : repeat.again + repeat.length]
    difference: Array = one - other
    return difference
