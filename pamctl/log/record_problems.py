"""What can be wrong with a record, whoever took it: one list for import, check, report, diagnosis.

frozen, clipped, spikes, resampled  of a sensor's column
duplicated                          a whole column that is there twice
short                               a record without two rows

Those of its rows and their times are in `row_problems`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from math import erf, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.base.texts import count_of
from pamctl.log.row_problems import (
    AROUND,
    JITTER,
    Flags,
    Floats,
    ProblemKind,
    RecordColumn,
    RecordProblem,
    find_gaps,
    find_runs,
    judge_numbers,
    judge_time,
    make_problem,
    make_whole_problem,
    nominal_period_s,
)
from pamctl.log.schema import IMPORTED_QUANTITIES, unit_of_column

Counts = NDArray[np.intp]

FEWEST_HELD = 20
"""Equal samples in a row that may be a frozen sensor; fewer are a dropout."""
CHANCE = 1e-3
"""Chance in a whole record that noise holds a value for as long as a frozen sensor."""
NOISE_STEPS = 0.5
"""Noise of so many steps of the converter shows in every sample; rounding alone makes 0.29."""
FLIPS = 0.6
"""Share of turns in noise: a smooth motion turns seldom, white noise in 0.73 of its samples."""
MOST_UNEVEN = 0.02
"""Share of uneven time steps; with more, a motion looks as rough as noise."""
BLOCK = 50
"""Samples whose noise is taken together."""
BESIDE = 12
"""Samples beside a held stretch that must show the noise which it lacks."""
STILL_PUSHED = 0.35
"""Share of another sensor's span within which a sensor may rest."""
ABRUPT, ABRUPT_STEPS = 0.4, 3.0
"""The last step before a sensor halts, as a share of those around and in steps of its converter:
what friction brings to rest is slower by then."""
USUALLY = 0.995
"""Share of the steps of a record among which its fastest motion is."""
JUMP, BACK = 9.0, 0.25
"""A spike is this many usual deviations away from its neighbours; and how far from its level before
it the signal may be afterwards, as a share of the jump."""
LONGEST_DROPOUT = 20
"""Samples that a spike, or a dropout, may last."""
MOST_SPIKES = 0.02
"""Share of the samples; more are no single spikes, but the signal."""
ANSWER, NO_ANSWER = 4, 0.3
"""Samples after a jump of the command in which a rig may begin to answer it by a jump; and the
share of its span that no rig goes and comes back at once if the command jumped only once."""
REGULAR = 0.95
"""Share of the changes that come at one interval in a resampled column."""
FEWEST_CHANGES = 20
MOST_COMPARED = 200
"""Stretches, the longest ones, that are compared with other sensors."""
MOST_SORTED = 100_000
"""Samples of a long column whose levels are looked at."""
JUMP_SHARE = 0.2
"""Share of its span by which a command jumps."""


def measured_columns(values: Mapping[str, NDArray[Any]]) -> list[RecordColumn]:
    """Return those of these columns that the valve or a sensor has; each is an array in SI."""
    return [
        RecordColumn(name, unit_of_column(name), values[name], is_sensor=name != "valve_v")
        for name in IMPORTED_QUANTITIES
        if name in values
    ]


@np.errstate(over="ignore", invalid="ignore")  # numbers of any size may be in a file
def find_record_problems(
    t_s: Floats, columns: Sequence[RecordColumn], time_name: str = "t_s"
) -> list[RecordProblem]:
    """Return all problems, those of the time first.

    `t_s` has shape (n,), as has each column. A command is only looked at for missing values, and
    for the jumps that a sensor may have answered.
    """
    t_s = np.asarray(t_s, np.float64)
    if len(t_s) < 2:
        there = "is 1 row" if len(t_s) else "are 0 rows"
        text = f"is no record: there {there}; a measurement needs at least two"
        return [make_whole_problem("short", time_name, text)._replace(is_fatal=True)]
    found = list(judge_time(t_s, time_name))
    is_ordered = not any(problem.is_fatal for problem in found)
    sensors: list[Sensor] = []
    jumps = np.zeros(len(t_s), np.intp)
    for column in columns:
        problems = list(judge_numbers(t_s, column))
        found += problems
        if any(problem.kind in ("empty", "constant") for problem in problems):
            continue
        if column.is_sensor:
            sensors.append(Sensor(column, t_s))
        else:
            jumps += count_jumps(column.values)
    if is_ordered:
        found += judge_sensors(t_s, sensors, jumps)
    for one, other in combinations(sensors, 2):
        if np.array_equal(one.column.values, other.column.values, equal_nan=True):
            text = f"holds the same numbers as {one.column.name}: one channel was stored twice"
            found.append(make_problem(t_s, "duplicated", other.column.name, text, [(0, len(t_s))]))
    return found


def find_sensor_step(values: Floats) -> float:
    """Return the step with which a column was digitised; 0 where none is visible.

    The step is the smallest difference between levels, if the others are whole multiples.
    Differences in time would not do: a motion at one speed has equal ones.
    """
    steps = np.diff(np.sort(values))
    steps = steps[steps > 1e-9 * max(float(np.ptp(values)), 1e-30)]
    if not len(steps):
        return 0.0
    # The smallest differences are one step each, apart from rounding.
    smallest = float(np.quantile(steps, 0.01))
    step = float(np.median(steps[steps < 1.5 * smallest]))
    multiples = steps[steps < 30.0 * step] / step
    off = np.abs(multiples - np.round(multiples))
    return step if len(multiples) > 1 and float(np.quantile(off, 0.95)) < 0.1 else 0.0


def round_to_steps(values: Floats, measured: Floats) -> Floats:
    """Return values made from measured ones, in the steps of their converter.

    A value between two levels would pass for a finer step, and a step of the converter for a spike.
    Where no reading is like the one before it, levels may be a steady motion's, and none is a rest.
    """
    good = measured[np.isfinite(measured)]
    step = find_sensor_step(good) if (np.diff(good) == 0.0).any() else 0.0
    return good[0] + np.round((values - good[0]) / step) * step if step else values


class Sensor:
    """A sensor's column, its gaps filled, with its noise and its converter's step."""

    def __init__(self, column: RecordColumn, t_s: Floats) -> None:
        self.column = column
        self.lost = ~np.isfinite(column.values)
        self.values = column.values
        if self.lost.any():
            index = np.where(self.lost, 0, np.arange(len(self.lost)))
            filled = column.values[np.maximum.accumulate(index)]
            self.values = np.where(np.isfinite(filled), filled, column.values[~self.lost][0])
        self.ends = (float(self.values.min()), float(self.values.max()))
        self.span = self.ends[1] - self.ends[0]
        every = -(-len(t_s) // MOST_SORTED)
        self.step = find_sensor_step(self.values[::every]) if column.step is None else column.step
        self.noise, flips = _measure_noise(self.values)
        self.fastest = float(np.quantile(np.abs(np.diff(self.values)), USUALLY))
        self.is_gap = find_gaps(t_s)
        uneven = ~(np.abs(np.diff(t_s) - nominal_period_s(t_s)) < JITTER * nominal_period_s(t_s))
        self.is_noisy = (
            self.noise > NOISE_STEPS * self.step
            and flips > FLIPS
            and float(uneven.mean()) < MOST_UNEVEN
        )
        """Whether its noise must show in every stretch of some samples."""


def _measure_noise(values: Floats) -> tuple[float, float]:
    """Return the usual noise, and how often it turns; white noise grows by sqrt(20) in a third
    difference, where a ramp vanishes.
    """
    second = np.diff(values, 2)
    third = np.diff(second)
    whole = len(third) // BLOCK * BLOCK
    blocks = third[:whole].reshape(-1, BLOCK) if whole else third.reshape(1, -1)
    scatter = np.sqrt(np.mean(blocks**2, axis=1) / 20.0) if third.size else np.zeros(1)
    alive = scatter[scatter > 0.0]
    signs = np.sign(second)
    both = signs[1:] * signs[:-1]
    moved = int(np.count_nonzero(both))
    flips = np.count_nonzero(both < 0.0) / moved if moved else 0.0
    return float(np.median(alive)) if len(alive) else 0.0, float(flips)


def judge_sensors(t_s: Floats, sensors: Sequence[Sensor], jumps: Counts) -> Iterator[RecordProblem]:
    """Yield where sensors hold a value, are resampled, or have spikes.

    `jumps`, shape (n,), counts those of the command up to each row.
    """
    frozen = [_find_frozen(sensor) for sensor in sensors]
    alive = [sensor for sensor, held in zip(sensors, frozen, strict=True) if not held]
    for sensor, held in zip(sensors, frozen, strict=True):
        others = [one for one in alive if one is not sensor]
        why = "and the motion goes on from another place"
        if sensor.is_noisy:
            why = "while its noise shows before and after"
        yield from (
            _judge_resampled(t_s, sensor)
            or _describe_held(t_s, sensor, held, why)
            or _judge_stopped(t_s, sensor, others)
        )
        yield from _judge_spikes(t_s, sensor, jumps)


def find_frozen(t_s: Floats, values: Floats) -> Flags:
    """Return the samples at which a sensor is frozen, shape (n,): they say nothing.

    `values` is its column, of the same shape, in any unit.
    """
    frozen = np.zeros(len(values), np.bool_)
    for start, stop in _find_frozen(Sensor(RecordColumn("", "", values), t_s)):
        frozen[start:stop] = True
    return frozen


def _find_frozen(sensor: Sensor) -> list[tuple[int, int]]:
    """Return where a sensor holds a value against its noise, or from a motion on to a jump."""
    is_stuck = _is_noise_beside if sensor.is_noisy else _is_jump_behind
    return [stretch for stretch in _find_held(sensor) if is_stuck(sensor, stretch)]


def _judge_stopped(t_s: Floats, sensor: Sensor, others: Sequence[Sensor]) -> list[RecordProblem]:
    """Return where a sensor holds a value while another one moves.

    Friction holds a position, which comes to rest and leaves it gently: no sensor does so. At an
    extreme one that does not is enough for all.
    """
    held = sorted(_find_held(sensor), key=lambda stretch: stretch[0] - stretch[1])[:MOST_COMPARED]
    cut = held = sorted(held)
    if sensor.column.name == "position_m":
        cut = [stretch for stretch in held if is_abrupt(sensor.values, sensor.step, stretch)]
    at_ends = [[s for s in held if sensor.values[s[0]] == extreme] for extreme in sensor.ends]
    groups = [there for there in at_ends if any(stretch in cut for stretch in there)]
    groups += [[stretch] for stretch in cut]
    moving = [(group, mover) for group in groups if (mover := _find_mover(others, group))]
    stopped = sorted({stretch for group, _ in moving for stretch in group})
    return _describe_held(t_s, sensor, stopped, f"while {moving[0][1]} moves" if moving else "")


def _describe_held(
    t_s: Floats, sensor: Sensor, held: Sequence[tuple[int, int]], why: str
) -> list[RecordProblem]:
    """Return the problem for stretches at an extreme, and the one for those between."""
    texts: dict[ProblemKind, tuple[str, str]] = {
        "clipped": ("stays at its extreme", "clipped, or at a stop"),
        "frozen": ("stands still at", "frozen"),
    }
    found = []
    for kind, (what, verdict) in texts.items():
        stretches = [s for s in held if _is_clipped(sensor, s) == (kind == "clipped")]
        if stretches:
            start, _ = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
            value = f"{float(sensor.values[start]):.6g} {sensor.column.unit}".rstrip()
            text = f"{what} {value}, {why}: it is {verdict}"
            found.append(make_problem(t_s, kind, sensor.column.name, text, stretches))
    return found


def _is_clipped(sensor: Sensor, stretch: tuple[int, int]) -> bool:
    leaves = sensor.is_noisy or not _is_jump_behind(sensor, stretch)  # noise is a jump as well
    return sensor.values[stretch[0]] in sensor.ends and leaves


def _find_held(sensor: Sensor) -> list[tuple[int, int]]:
    """Return the stretches of equal values that are too long for chance."""
    equal = (np.diff(sensor.values) == 0.0) & ~sensor.lost[1:]
    runs = find_runs(equal)
    lengths = runs[:, 1] - runs[:, 0]
    long = lengths >= FEWEST_HELD - 1
    in_long = int(lengths[long].sum())
    share = (int(equal.sum()) - in_long) / max(len(equal) - in_long, 1)  # of equal neighbours
    if sensor.is_noisy:  # at rest in the middle of a step it makes more of them than in a motion
        white = sqrt(max(sensor.noise**2 - sensor.step**2 / 12.0, 1e-12 * sensor.noise**2))
        share = max(share, erf(0.5 * sensor.step / (sqrt(2.0) * white)))
    least = np.log(CHANCE / len(equal)) / np.log(min(max(share, 1e-9), 0.99))
    return [(start, stop + 1) for start, stop in runs[long & (lengths > least)].tolist()]


def _is_noise_beside(sensor: Sensor, stretch: tuple[int, int]) -> bool:
    """Tell whether the noise goes on beside a stretch, as far as the record does.

    Noise that is cut at an extreme comes back in between: what is not held there counts.
    """
    values, held, far = sensor.values, sensor.values[stretch[0]], BLOCK * BESIDE
    sides = (values[: stretch[0]][-far:][::-1], values[stretch[1] :][:far])
    if held in sensor.ends:
        sides = (sides[0][sides[0] != held], sides[1][sides[1] != held])
    beside = [side[:BESIDE] for side in sides if len(side) >= BESIDE]
    return bool(beside) and all(_measure_noise(b)[0] > 0.3 * sensor.noise for b in beside)


def _is_jump_behind(sensor: Sensor, stretch: tuple[int, int]) -> bool:
    """Tell whether a motion goes on from another place than where the sensor held.

    A motion that halts abruptly shows its speed. A rest is left by a jump beyond all speeds of the
    record, into a motion: where rows come slowly, a rig that settles makes jumps, too.
    """
    before, after = _steps_beside(sensor.values, stretch)
    if len(before) < AROUND or len(after) < AROUND or sensor.is_gap[stretch[1] - 1]:
        return False
    usual = max(float(np.median(before)), float(np.median(after[1:])), sensor.step)
    if is_abrupt(sensor.values, sensor.step, stretch):
        return bool(after[0] > JUMP * usual)
    goes_on = float(np.median(after[1:])) > ABRUPT_STEPS * sensor.step
    return goes_on and bool(after[0] > JUMP * max(usual, sensor.fastest))


def is_abrupt(values: Floats, step: float, stretch: tuple[int, int]) -> bool:
    """Tell whether a value is held and left at the speed of the motion around, if there is any.

    `step` is the converter's. Friction slows down what it holds; a sensor is cut off in motion.
    """
    return all(
        steps[0] > max(ABRUPT * float(np.median(steps)), ABRUPT_STEPS * step)
        for steps in _steps_beside(values, stretch)
        if len(steps)
    )


def _steps_beside(values: Floats, stretch: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return the sizes of the steps before and after a stretch, the nearest one first."""
    start, stop = stretch
    before = np.abs(np.diff(values[max(start - AROUND, 0) : start + 1]))
    return before[::-1], np.abs(np.diff(values[stop - 1 : stop + AROUND]))


def _find_mover(others: Sequence[Sensor], stretches: Sequence[tuple[int, int]]) -> str | None:
    """Return the sensor that moves, in these stretches, farther than friction holds another."""
    for other in others:
        values = np.concatenate([other.values[start:stop] for start, stop in stretches])
        low, high = np.quantile(values, (0.02, 0.98))
        jump = max(float(np.abs(np.diff(other.values[a:b])).max()) for a, b in stretches)
        if high - low - jump > max(STILL_PUSHED * other.span, 10.0 * other.noise):
            return other.column.name
    return None


def _judge_resampled(t_s: Floats, sensor: Sensor) -> list[RecordProblem]:
    """Return that a column has fewer samples than rows: held, or on straight lines, in between."""
    step = np.diff(sensor.values)
    bend = np.abs(np.diff(step))
    changes = np.flatnonzero(step)
    kinks = np.flatnonzero(bend > max(2.5 * sensor.step, 1e-9 * sensor.span))
    # A motion at one speed changes at one interval too, but always by one step of the converter.
    is_coarse = len(changes) and float(np.median(np.abs(step[changes]))) <= 3.0 * sensor.step
    held = None if is_coarse else _find_interval(changes, len(step))
    rows = held or _find_interval(kinks, len(bend))
    if rows is None:
        return []
    how = "held" if held else "interpolated"
    rate_hz = 1.0 / (rows * nominal_period_s(t_s))
    text = f"was sampled at {rate_hz:.3g} Hz and {how} in between: it changes every {rows} rows"
    return [make_problem(t_s, "resampled", sensor.column.name, text, [(0, len(t_s))])]


def _find_interval(rows: NDArray[np.intp], length: int) -> int | None:
    """Return the one interval at which rows come; None where they do not."""
    if not FEWEST_CHANGES <= len(rows) <= length // 2:
        return None
    apart = np.diff(rows)
    every = int(np.median(apart))
    if not 2 <= every <= BLOCK:
        return None
    rest = np.abs(apart - np.rint(apart / every) * every)
    return every if float(np.mean(rest <= every // 8)) >= REGULAR else None


def _judge_spikes(t_s: Floats, sensor: Sensor, jumps: Counts) -> Iterator[RecordProblem]:
    """Yield what leaves the signal and is back at once."""
    spikes = [*find_excursions(sensor.values, jumps)]
    if 0 < sum(stop - start for start, stop in spikes) <= MOST_SPIKES * len(t_s):
        text = f"has {count_of(len(spikes), 'spike')} that no rig makes"
        yield make_problem(t_s, "spikes", sensor.column.name, text, spikes)


def count_jumps(command: Floats) -> Counts:
    """Return the jumps of a command up to each row, shape (n,)."""
    least = JUMP_SHARE * max(float(np.nanmax(command) - np.nanmin(command)), 1e-9)
    return np.cumsum(np.abs(np.diff(command, prepend=command[:1])) >= least)


def find_excursions(values: Floats, jumps: Counts) -> Iterator[tuple[int, int]]:
    """Yield [start, stop) of what jumps away and comes back at once.

    No rig can have made it, since it would have to return. A step, a click of dry friction or a
    burst of noise is not back, or is as busy before and after. `values` are finite.
    """
    from scipy.ndimage import median_filter  # 0.3 s, and who reads signals needs none of it

    steps = np.diff(values)
    steps -= median_filter(steps, 2 * AROUND + 1, mode="nearest")  # the motion's own
    sizes = np.abs(steps)
    # The usual step around, without the jump itself: a median hardly sees it.
    usual = np.maximum(
        median_filter(sizes, 2 * AROUND + 1, mode="nearest") / 0.6745,
        max(float(np.median(sizes)) / 0.6745, find_sensor_step(values)),
    )
    done, span = 0, float(np.ptp(values))
    for jump in np.flatnonzero(sizes > JUMP * usual).tolist():
        start = jump + 1
        if start <= done or start < AROUND:
            continue
        stop = _find_return(values, start, float(sizes[jump]), float(usual[jump]))
        if stop is None:
            continue
        # A rig may answer a jump of the command by one. It does not go far and come back by itself.
        before = jumps[start - ANSWER]
        if jumps[start] > before and (jumps[stop] > before + 1 or sizes[jump] < NO_ANSWER * span):
            continue
        done = stop
        yield start, stop


def _find_return(values: Floats, start: int, jump: float, usual: float) -> int | None:
    """Return where a signal that jumped at `start` is back; None if it is not."""
    before = values[start - AROUND : start]
    slope = float(np.median(np.diff(before)))
    for stop in range(start + 1, min(start + LONGEST_DROPOUT, len(values) - AROUND) + 1):
        expected = before[-1] + slope * (stop - start + 1)
        off = abs(values[stop] - expected)
        if off > max(BACK * jump, 3.0 * usual) or off > 0.5 * jump:
            continue
        if float(np.abs(values[start:stop] - expected).min()) < 0.5 * jump:
            return None
        # The largest step around but for two: another outlier may be close by.
        around = (before, values[stop : stop + AROUND])
        busy = max(float(np.sort(np.abs(np.diff(part) - slope))[-3]) for part in around)
        return stop if busy < 0.4 * jump else None
    return None
