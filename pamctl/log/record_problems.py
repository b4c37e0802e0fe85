"""What can be wrong with a record, whoever took it: one list for import, check, report, diagnosis.

frozen, clipped, spikes, resampled       of a sensor's column
missing, infinite, empty, constant       of any column; empty: not one number in it
duplicated                               a time, or a whole column, that is there twice
backwards, reversed, gap, jitter, short  of the time
misnumbered                              of the loop's count of ticks
schema, version                          of what a log says of its columns
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.log.reading.column_problems import (
    JITTER,
    Floats,
    ProblemKind,
    RecordColumn,
    RecordProblem,
    Sensor,
    find_runs,
    find_sensor_step,
    judge_numbers,
    judge_sensors,
    make_problem,
    nominal_period_s,
)

__all__ = [
    "RecordColumn",
    "RecordProblem",
    "find_record_problems",
    "find_sensor_step",
    "judge_first_tick",
    "judge_schema",
    "nominal_period_s",
]

GAP_PERIODS = 1.5
"""A longer step of the time has missed rows."""
JUMP_SHARE = 0.2
"""Share of its span by which a command jumps."""


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
        return [_make_of_all("short", time_name, text)._replace(is_fatal=True)]
    found = list(_judge_time(t_s, time_name))
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
            steps = np.abs(np.diff(column.values, prepend=column.values[:1]))
            jumps += np.cumsum(steps >= JUMP_SHARE * np.nanmax(steps))
    if is_ordered:
        found += judge_sensors(t_s, sensors, jumps)
    for one, other in combinations(sensors, 2):
        if np.array_equal(one.column.values, other.column.values, equal_nan=True):
            text = f"holds the same numbers as {one.column.name}: one channel was stored twice"
            found.append(make_problem(t_s, "duplicated", other.column.name, text, [(0, len(t_s))]))
    return found


# What a log says of itself.

MOST_OFF_TICKS = 100.0
"""Ticks by which number and time may differ: a card's clock is not the computer's."""
FIRST_TICKS = 100
"""Ticks whose median step is taken as the period."""


def judge_schema(topic: str, label: str, version: str) -> Iterator[RecordProblem]:
    """Yield what is wrong with the label and the version of the schema of a log's ticks."""
    if label != "protobuf":
        text = f"is protobuf, but is labelled {label!r}: other tools will not read the ticks"
        yield _make_of_all("schema", f"the schema of {topic}", text)
    if not (version.isdecimal() and int(version)):
        text = f"is {version!r}; versions begin with 1"
        yield _make_of_all("version", f"the schema version of {topic}", text)


def judge_first_tick(tick: NDArray[Any], t_s: Floats) -> Iterator[RecordProblem]:
    """Yield that the first tick has a number far from its time; arrays of shape (n,)."""
    with np.errstate(invalid="ignore"):  # a time may be infinite
        period_s = float(np.median(np.diff(t_s[:FIRST_TICKS]))) if len(t_s) > 1 else 0.0
    by_time = float(t_s[0]) / period_s if period_s > 0.0 else np.nan
    if abs(float(tick[0]) - by_time) > MOST_OFF_TICKS + 0.05 * abs(by_time):
        text = f"has the number {tick[0]} at {t_s[0]:g} s: by its time it is tick {by_time:.0f}"
        yield _make_of_all("misnumbered", "the first tick", text)


def _make_of_all(kind: ProblemKind, what: str, text: str) -> RecordProblem:
    return RecordProblem(kind, what, text, (), np.nan, np.nan, 1.0, is_fatal=False)


# The time.


def _judge_time(t_s: Floats, name: str) -> Iterator[RecordProblem]:
    bad = ~np.isfinite(t_s)
    if bad.any():
        text = "is missing or not finite"
        yield make_problem(t_s, "missing", name, text, find_runs(bad), is_fatal=True)
        return
    step = np.diff(t_s)
    if (step < 0.0).all():
        text = "runs backwards from the first row to the last: turn the order of the rows round"
        yield make_problem(t_s, "reversed", name, text, [(0, len(t_s))], is_fatal=True)
        return
    back, same = np.flatnonzero(step < 0.0) + 1, step == 0.0
    if len(back) == 1 and np.array_equal(t_s[back[0] :], t_s[: len(t_s) - back[0]]):
        text = "begins again: the record is there twice; keep it once"
        yield make_problem(t_s, "duplicated", name, text, [(int(back[0]), len(t_s))], is_fatal=True)
        return
    if len(back):
        fall_s = float(step.min())
        text = f"goes backwards, by up to {-fall_s:.6g} s"
        stretches = [(int(row), int(row) + 1) for row in back]
        yield make_problem(t_s, "backwards", name, text, stretches, is_fatal=True)
    if same.any():
        text = "repeats the previous row's"
        yield make_problem(t_s, "duplicated", name, text, find_runs(same) + 1, is_fatal=True)
    if len(back) or same.any():
        return
    period_s = float(np.median(step))
    gap = step > GAP_PERIODS * period_s
    if gap.any():
        count = int(np.count_nonzero(gap))
        text = f"has {count} gap{'s' * (count > 1)} of up to {float(step.max()):.6g} s, before"
        stretches = [(int(row) + 1, int(row) + 2) for row in np.flatnonzero(gap)]
        yield make_problem(t_s, "gap", name, text, stretches)
    off = np.abs(step / period_s - 1.0)
    off[gap] = 0.0
    if off.max() > JITTER:
        text = f"steps differ from {period_s:.6g} s by up to {float(off.max()):.0%}"
        yield make_problem(t_s, "jitter", name, text, [(0, len(t_s))])
