"""One thing that is wrong with a record, and what can be wrong with its rows and their times.

missing, infinite, empty, constant  of any column; empty: not one number in it
missing, duplicated, backwards      of the time, as are these three:
reversed, gap, jitter
misnumbered                         of the loop's count of ticks
schema, version                     of what a log says of its columns
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.base.texts import count_of

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

ProblemKind = Literal[
    "frozen", "clipped", "spikes", "resampled", "missing", "infinite", "empty", "constant",
    "duplicated", "backwards", "reversed", "gap", "jitter", "short",
    "misnumbered", "schema", "version",
]  # fmt: skip

SHOWN_STRETCHES = 5
JITTER = 0.05
"""Deviation from the even grid that is a problem, as a share of the period."""
GAP_PERIODS = 1.5
"""A longer step of the time has missed rows, unless its neighbours make up for it."""
LEAST_MOVED = 0.2
"""Share of a period by which all stamps after a gap are later than all before it: jitter takes the
rest of the period that is missed."""
AROUND = 8
"""Samples beside a gap or a spike that show what it moves, or how busy the signal is."""


class RecordColumn(NamedTuple):
    """A column of a record."""

    name: str
    unit: str
    values: Floats
    """Shape (n,); NaN where nothing was measured."""
    step: float | None = None
    """The converter's step, in `unit`; 0 for none; None where it is to be found in the values."""
    is_sensor: bool = True
    """False for a command: it may hold a value, and jump, as it likes."""


class RecordProblem(NamedTuple):
    """One thing that is wrong with a record."""

    kind: ProblemKind
    column: str
    text: str
    """What is wrong, without the place."""
    stretches: tuple[tuple[int, int], ...]
    """Rows [start, stop), from 0, in order; all of them."""
    from_s: float
    """Time of the first row concerned; NaN where the time is unknown."""
    to_s: float
    """Time of the last row concerned."""
    share: float
    """Part of the record's rows that is concerned, 0 to 1."""
    is_fatal: bool
    """Whether nothing right can be computed from the record before this is repaired."""

    def describe(self, numbers: Sequence[int] | NDArray[np.int64] | None = None) -> str:
        """Return the problem with its place; `numbers` are those of the rows in the source."""
        if self.share >= 1.0 or not self.stretches:
            return f"{self.column} {self.text}"
        shown = []
        for start, stop in self.stretches[:SHOWN_STRETCHES]:
            rows = [start, stop - 1] if numbers is None else [numbers[start], numbers[stop - 1]]
            shown.append(" to ".join(str(row) for row in dict.fromkeys(rows)))
        more = len(self.stretches) - len(shown)
        rest = f" and {more} more" if more else ""
        is_one = len(self.stretches) == 1 and self.stretches[0][1] - self.stretches[0][0] == 1
        times = [f"{t_s:.6g}" for t_s in dict.fromkeys((self.from_s, self.to_s)) if t_s == t_s]
        when = f" ({' to '.join(times)} s)" if times else ""
        return f"{self.column} {self.text}: row{'s'[is_one:]} {', '.join(shown)}{rest}{when}"


def find_runs(flags: Flags) -> NDArray[np.int64]:
    """Return the stretches [start, stop) of True, shape (stretches, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0]))))
    return edges.astype(np.int64).reshape(-1, 2)


def make_problem(
    t_s: Floats,
    kind: ProblemKind,
    column: str,
    text: str,
    stretches: NDArray[np.int64] | Sequence[tuple[int, int]],
    *,
    is_fatal: bool = False,
) -> RecordProblem:
    """Return a problem that concerns these stretches of rows, [start, stop)."""
    places = [(int(start), int(stop)) for start, stop in stretches]
    share = sum(stop - start for start, stop in places) / len(t_s)
    from_s, to_s = float(t_s[places[0][0]]), float(t_s[places[-1][1] - 1])
    return RecordProblem(kind, column, text, tuple(places), from_s, to_s, share, is_fatal)


def make_whole_problem(kind: ProblemKind, what: str, text: str) -> RecordProblem:
    """Return a problem without a place: it concerns the whole record."""
    return RecordProblem(kind, what, text, (), np.nan, np.nan, 1.0, is_fatal=False)


# What a log says of itself.

MOST_OFF_TICKS = 100.0
"""Ticks by which number and time may differ: a card's clock is not the computer's."""
FIRST_TICKS = 100
"""Ticks whose median time for a tick is taken as the period."""


def judge_schema(topic: str, label: str, version: str) -> Iterator[RecordProblem]:
    """Yield what is wrong with the label and the version of the schema of a log's ticks."""
    if label != "protobuf":
        text = f"is protobuf, but is labelled {label!r}: other tools will not read the ticks"
        yield make_whole_problem("schema", f"the schema of {topic}", text)
    if not (version.isdecimal() and int(version)):
        text = f"is {version!r}; versions begin with 1"
        yield make_whole_problem("version", f"the schema version of {topic}", text)


def judge_first_tick(tick: NDArray[Any], t_s: Floats) -> Iterator[RecordProblem]:
    """Yield that the first tick has a number far from its time; arrays of shape (n,)."""
    period_s = find_tick_period_s(tick, t_s)
    by_time = float(t_s[0]) / period_s if period_s > 0.0 else np.nan
    if abs(float(tick[0]) - by_time) > MOST_OFF_TICKS + 0.05 * abs(by_time):
        text = f"has the number {tick[0]} at {t_s[0]:g} s: by its time it is tick {by_time:.0f}"
        yield make_whole_problem("misnumbered", "the first tick", text)


def find_tick_period_s(tick: NDArray[Any], t_s: Floats) -> float:
    """Return the time for a tick, s, by the first ticks, however many are missed; else NaN."""
    step = np.diff(tick[:FIRST_TICKS])
    with np.errstate(invalid="ignore"):  # a time may be infinite
        times_s = np.diff(t_s[:FIRST_TICKS])[step > 0] / step[step > 0]
        return float(np.median(times_s)) if len(times_s) else float("nan")


# The time.


def judge_time(t_s: Floats, name: str) -> Iterator[RecordProblem]:
    """Yield what is wrong with the times of the rows; `name` is what the file calls them."""
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
    gap = find_gaps(t_s)
    if gap.any():
        count = int(np.count_nonzero(gap))
        text = f"has {count_of(count, 'gap')} of up to {float(step.max()):.6g} s, before"
        stretches = [(int(row) + 1, int(row) + 2) for row in np.flatnonzero(gap)]
        yield make_problem(t_s, "gap", name, text, stretches)
    off = np.abs(step / period_s - 1.0)
    off[gap] = 0.0
    if off.max() > JITTER:
        text = f"steps differ from {period_s:.6g} s by up to {float(off.max()):.0%}"
        yield make_problem(t_s, "jitter", name, text, [(0, len(t_s))])


def find_gaps(t_s: Floats) -> Flags:
    """Return which time steps have missed rows, shape (n - 1,); `t_s`, shape (n,), rises.

    A step that is long but made up for by its neighbours is jitter: it moves one stamp, where a
    missed row moves all that follow.
    """
    step, period_s = np.diff(t_s), nominal_period_s(t_s)
    long = np.flatnonzero(step > GAP_PERIODS * period_s)
    late_s = t_s - period_s * np.arange(len(t_s))
    before = np.maximum(long[:, None] - np.arange(AROUND), 0)
    after = np.minimum(long[:, None] + 1 + np.arange(AROUND), len(t_s) - 1)
    moved_s = late_s[after].min(axis=1) - late_s[before].max(axis=1)
    gaps = np.zeros(len(step), np.bool_)
    gaps[long[moved_s > LEAST_MOVED * period_s]] = True
    return gaps


def nominal_period_s(t_s: Floats) -> float:
    """Return the sampling period, estimated as the median time step."""
    return float(np.median(np.diff(t_s)))


def judge_numbers(t_s: Floats, column: RecordColumn) -> Iterator[RecordProblem]:
    """Yield where a column has no numbers, or only one."""
    values, whole = column.values, [(0, len(t_s))]
    good = values[np.isfinite(values)]
    if not len(good):
        yield make_problem(t_s, "empty", column.name, "has no values", whole, is_fatal=True)
        return
    lost: dict[ProblemKind, Flags] = {"missing": np.isnan(values), "infinite": np.isinf(values)}
    for kind, where in lost.items():
        if count := int(np.count_nonzero(where)):
            text = f"is {kind} in {count_of(count, 'row')}"
            yield make_problem(t_s, kind, column.name, text, find_runs(where))
    if float(good.min()) == float(good.max()):
        text = f"is {float(good[0]):.6g} {column.unit} throughout"
        yield make_problem(t_s, "constant", column.name, text, whole)
