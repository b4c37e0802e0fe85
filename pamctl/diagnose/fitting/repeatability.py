"""How well the rig repeats itself, where the records demand the same of it again.

No model can explain what is different each time. For two runs with the same past, the residuals
of any model differ by that and by the sensors' noise; what the model lacks is the same in both.

In closed loop the same reference leads to nearly the same commands, and where nothing commands, a
measured force or motion may come again. Each run is simulated with its own input. The effect of the
differences on the simulation is then subtracted in full, as if the model were wrong about all of
it: a loop that hunts gives no information rather than a wrong one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.measured.record import Array, Record, estimate_quiet_noise
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
SAME_SHARE, SAME_NOISES = 0.01, 8.0
"""Measured inputs are the same within this share of their span, or this multiple of their noise."""
MOVES_SHARE = 0.3
"""A measured input must vary by this share of its span in a repeat."""
ASKED, MEASURED = ("valve_v", "reference_m"), ("force_n", "position_m")
"""What a rig may be asked for, the strictest first. Of the measured ones, each is the demand of the
blocks whose output it is not."""


class Repeat(NamedTuple):
    """Samples [start, start + length) of one record and [again, ...) of another, or the same."""

    one: int
    start: int
    other: int
    again: int
    length: int
    demand: str = "valve_v"
    """What is equal in both; where it is not the command, the inputs differ a little."""


class RepeatSpread(NamedTuple):
    """How far a block is from repeating itself."""

    rms: float
    """In deviations of its sensor, with the sensor's noise; 0 where nothing is repeated."""
    uncertainty: float
    """Relative uncertainty of the part that is not sensor noise, one sigma."""


UNKNOWN = RepeatSpread(0.0, 0.0)


def find_repeats(records: Sequence[Record]) -> tuple[Repeat, ...]:
    """Find where different runs, or different parts of a run, have the same demand.

    The demand is the command; where commands differ, the reference. Rigs without a command are
    asked by a measured force, or by a motion that something else imposes.
    """
    known = list(enumerate(records))
    across = [repeat for a, b in combinations(known, 2) for repeat in _find_across_runs(a, b)]
    return (*across, *(repeat for i, r in known for repeat in _find_within_run(i, r)))


def _find_across_runs(a: tuple[int, Record], b: tuple[int, Record]) -> Iterator[Repeat]:
    (one, first), (other, second) = a, b
    size = min(len(first), len(second))
    same_grid = abs(first.period_s - second.period_s) < 1e-3 * first.period_s
    if first is second or not same_grid:
        return
    for demand in _list_demands(first):
        if demand not in _list_demands(second):
            continue
        asked, again = _read_demand(first, demand), _read_demand(second, demand)
        differs = _find_differences(asked[:size], again[:size], demand)
        length = int(np.argmax(differs)) if differs.any() else size
        if _is_telling(first, demand, 0, length):
            yield Repeat(one, 0, other, 0, length, demand)
            if demand not in MEASURED:
                return


def _list_demands(record: Record) -> list[str]:
    """Return what may have been asked of the rig; what it measures counts without a command."""
    names = ASKED if record.valve_v is not None else (*ASKED, *MEASURED)
    return [name for name in names if getattr(record, name) is not None]


def _read_demand(record: Record, demand: str) -> Array:
    values: Array = getattr(record, demand)
    return values


def _find_differences(one: Array, other: Array, demand: str) -> NDArray[np.bool_]:
    """Tell where two demands differ; samples without a reference count as different."""
    if demand in MEASURED:
        noise = max(estimate_quiet_noise(one), estimate_quiet_noise(other))
        same = max(SAME_SHARE * float(np.ptp(one)), SAME_NOISES * noise)
        # Two runs are sampled at other instants of the same motion.
        low, high = minimum_filter1d(other, 3) - same, maximum_filter1d(other, 3) + same
        outside: NDArray[np.bool_] = (one < low) | (one > high)
        return outside
    alike: NDArray[np.bool_] = np.abs(one - other) <= (0.0 if demand == "valve_v" else SAME_M)
    return ~alike


def _find_within_run(index: int, record: Record) -> Iterator[Repeat]:
    """Find the longest stretch that comes again after some time, as periods do."""
    for demand in _list_demands(record):
        best = _find_longest(index, record, demand)
        if best is not None:
            yield best
            if demand not in MEASURED:
                return


def _find_longest(index: int, record: Record, demand: str) -> Repeat | None:
    past = round(PAST_S / record.period_s)
    asked = _read_demand(record, demand)
    starts = _find_period_starts(asked, demand)
    best: Repeat | None = None
    for lag in sorted({int(lag) for lag in (starts[1:60] - starts[:1])}):
        differs = np.flatnonzero(_find_differences(asked[lag:], asked[:-lag], demand))
        edges = np.concatenate([[-1], differs, [len(asked) - lag]])
        longest = int(np.argmax(np.diff(edges)))
        start, stop = int(edges[longest]) + 1 + past, int(edges[longest + 1])
        if (best is None or stop - start > best.length) and _is_telling(
            record, demand, start, stop - start
        ):
            best = Repeat(index, start, index, start + lag, stop - start, demand)
    return best


def _find_period_starts(asked: Array, demand: str) -> NDArray[np.intp]:
    """Return where a period may begin: where a command jumps, or another demand rises past half."""
    if demand == "valve_v":
        return np.flatnonzero(np.abs(np.diff(asked)) > MOVES_V) + 1
    half = 0.5 * (np.nanmin(asked) + np.nanmax(asked))
    return np.flatnonzero((asked[:-1] < half) & (asked[1:] >= half)) + 1


def _is_telling(record: Record, demand: str, start: int, length: int) -> bool:
    if length * record.period_s < LEAST_S:
        return False
    if record.valve_v is not None:
        return float(np.ptp(record.valve_v[start : start + length])) > MOVES_V
    asked = _read_demand(record, demand)
    return float(np.ptp(asked[start : start + length])) > MOVES_SHARE * float(np.ptp(asked))


def measure_repeatability(
    drives: Sequence[Drive], settings: PlantSettings, repeats: Sequence[Repeat]
) -> RepeatSpread:
    """Return how far a block is from repeating itself.

    `drives` are in the order of the records in which the repeats were found.
    """
    # An output that comes again is no demand.
    repeats = [r for r in repeats if r.demand != drives[r.one].channel]
    if not repeats:
        return UNKNOWN
    left: dict[int, Array] = {}
    simulated: dict[int, Array] = {}
    for index in {i for r in repeats for i in (r.one, r.other)}:
        drive = replace(drives[index], usable=None, part=None)
        output = drive.simulate(settings)
        left[index] = drive.residual_of(output)
        simulated[index] = output / drive.deviation
    differences = np.concatenate([_difference(left, r) for r in repeats])
    # With equal commands, simulated differences come from the rig and are not subtracted.
    simulated_differences = [_difference(simulated, r) for r in repeats if r.demand != "valve_v"]
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
