"""The health of a rig over a folder of logs: the numbers of each run, and how they change."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from math import hypot
from pathlib import Path
from typing import Literal

import numpy as np

from pamctl.base.errors import ExitCode
from pamctl.diagnose.evidence.input_noise import count_input_noise
from pamctl.diagnose.evidence.intervals import find_intervals
from pamctl.diagnose.evidence.ladder import fit_number
from pamctl.diagnose.evidence.pool import CHAIN
from pamctl.diagnose.evidence.weigh import prepare_weigher
from pamctl.diagnose.mend import mend_records
from pamctl.diagnose.plant_numbers import FittedNumber, with_values
from pamctl.diagnose.read_record import record_of
from pamctl.diagnose.record import Array, Record
from pamctl.diagnose.refuse import BadData, check_measured_runs
from pamctl.log.framing import LogError
from pamctl.plant.model import PlantSettings

PRESSURE = "pressure"
MISFIT = " misfit"
"""Ends the name of a channel's misfit, which is followed like a number."""
MISFIT_SCATTER = 0.15
"""Relative half width of a misfit over its sensor's noise."""
PRESSURE_SCATTER = 0.05
"""Half width of the pressure's misfit where the model explains it: runs of an unchanged rig differ
by 0.06 of the noise at most (140 runs of 35 hidden rigs); those of the position by 0.4."""
SHORTEST_S = 3.0


@dataclass(frozen=True)
class FittedRun:
    """A run with its numbers; or why it has none."""

    name: str
    when_s: float
    experiment: str = ""
    numbers: Mapping[str, FittedNumber] = field(default_factory=dict)
    """Fitted numbers by name, and the misfit of each channel, over its sensor's noise.

    Less than the noise says only that this run's was taken for larger than it is: it counts as 1.
    """
    refused: str = ""


@dataclass(frozen=True)
class Stated:
    """What the user says of the logs."""

    accepted: Mapping[str, str] = field(default_factory=dict)
    """Reasons by the rule about the data that they overrule."""
    noise: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations by channel, in SI."""


def fit_log(path: Path, when_s: float, plant: PlantSettings, stated: Stated) -> FittedRun:
    """Fit a log; a log that cannot be used is returned with the reason."""
    try:
        record = record_of(path)
        return replace(fit_record(record, plant, stated), name=path.name, when_s=when_s)
    except (LogError, BadData, OSError) as error:
        return FittedRun(path.name, when_s, refused=" ".join(str(error).split()))


def fit_record(record: Record, plant: PlantSettings, stated: Stated = Stated()) -> FittedRun:
    """Fit a record; raise `BadData` where it cannot be fitted."""
    (record,), _ = mend_records([record])
    of_plant = plant.noise.stated if plant.noise is not None else {}
    known = {**record.stated_noise, **of_plant, **stated.noise}
    record = replace(record, stated_noise=known)
    if record.duration_s < SHORTEST_S:
        raise BadData(f"{record.duration_s:.1f} s after homing; {SHORTEST_S:g} s are needed")
    check_measured_runs([record], plant, stated.accepted)
    try:
        weigher, start = prepare_weigher([record], (), plant)
    except ValueError as error:
        raise BadData(str(error)) from None
    m = weigher.settle(start)
    count_input_noise(weigher, m, known)
    left2 = weigher.like.mean_squares(m.d) / weigher.find_noise2(m)
    ratios = {
        channel.split("_")[0]: max(float(ratio), 1.0)
        for channel, ratio in zip(weigher.train.channels, np.sqrt(left2), strict=True)
    }
    numbers = {
        name: _widen_by_misfit(fit_number(name, m.values[name], ends), max(ratios.values()))
        for name, ends in find_intervals(weigher, m).items()
        if not name.startswith(CHAIN)
    }
    for short, ratio in ratios.items():
        half = MISFIT_SCATTER * ratio
        if short == PRESSURE:
            half = hypot(PRESSURE_SCATTER, MISFIT_SCATTER * (ratio - 1.0))
        name = short + MISFIT
        numbers[name] = FittedNumber(name, ratio, ratio - half, ratio + half, "x noise")
    return FittedRun(record.name, 0.0, record.experiment, numbers)


def _widen_by_misfit(number: FittedNumber, ratio: float) -> FittedNumber:
    """Widen an interval by what is left beyond a misfit's scatter: what is left moves numbers."""
    factor = max(ratio / (1.0 + MISFIT_SCATTER), 1.0)
    low, high = (number.value + factor * (end - number.value) for end in (number.low, number.high))
    return replace(number, low=low, high=high)


SIGMAS_OF_CI90 = 1.645
SURE = 20.0
"""Least fall of chi-squared: 4.5 sigma, for some ten numbers whose intervals are estimates."""
FEWEST_FOR_TREND = 5
FEWEST_FOR_SCATTER = 6
MEDIAN_OF_CHI2 = 0.455
"""Median of chi-squared with one degree of freedom."""

DriftKind = Literal["step", "trend"]


@dataclass(frozen=True)
class NumberDrift:
    """How a number changed over the runs."""

    name: str
    kind: DriftKind
    first: int
    """The last run before a step, or the first run of a trend."""
    second: int
    """The first run after a step, or the last run of a trend."""
    before: float
    after: float
    unit: str
    sigmas: float
    """The change over its uncertainty."""

    @property
    def relative(self) -> float:
        """The change over the value before; not finite for a value that was zero."""
        return (self.after - self.before) / abs(self.before) if self.before else float("inf")


def find_drift(
    name: str, numbers: Sequence[FittedNumber], times_s: Sequence[float]
) -> NumberDrift | None:
    """Return the strongest change of one number over its runs, in order; None if there is none."""
    if len(numbers) < 2:
        return None
    values = np.array([n.value for n in numbers])
    sigmas = np.array([max(n.high - n.low, 1e-12 * abs(n.value)) for n in numbers])
    sigmas = _widen_by_scatter(values, np.maximum(sigmas / (2.0 * SIGMAS_OF_CI90), 1e-300))
    weights = 1.0 / sigmas**2
    left = _chi2(values, weights)
    steps = [
        left - _chi2(values[:k], weights[:k]) - _chi2(values[k:], weights[k:])
        for k in range(1, len(values))
    ]
    at = int(np.argmax(steps))
    needed = SURE + 2.0 * float(np.log(len(steps)))
    unit = numbers[0].unit
    best: tuple[float, NumberDrift] | None = None
    if steps[at] > needed:
        before, after = (
            _mean(values[: at + 1], weights[: at + 1]),
            _mean(values[at + 1 :], weights[at + 1 :]),
        )
        sure = float(np.sqrt(steps[at]))
        best = steps[at], NumberDrift(name, "step", at, at + 1, before, after, unit, sure)
    if len(values) >= FEWEST_FOR_TREND:
        line, gain = _fit_trend(values, weights, np.array(times_s), left)
        if gain > SURE and (best is None or gain > best[0]):
            ends = float(line[0]), float(line[-1])
            sure = float(np.sqrt(gain))
            best = gain, NumberDrift(name, "trend", 0, len(values) - 1, *ends, unit, sure)
    return None if best is None else best[1]


def _widen_by_scatter(values: Array, sigmas: Array) -> Array:
    if len(values) < FEWEST_FOR_SCATTER:
        return sigmas
    steps = np.diff(values) ** 2 / (sigmas[:-1] ** 2 + sigmas[1:] ** 2)
    widened: Array = sigmas * np.sqrt(max(1.0, float(np.median(steps)) / MEDIAN_OF_CHI2))
    return widened


def _mean(values: Array, weights: Array) -> float:
    return float(np.sum(weights * values) / np.sum(weights))


def _chi2(values: Array, weights: Array) -> float:
    return float(np.sum(weights * (values - _mean(values, weights)) ** 2))


def _fit_trend(values: Array, weights: Array, times_s: Array, left: float) -> tuple[Array, float]:
    """Return the line at each run, and by how much it lowers chi-squared."""
    if np.ptp(times_s) <= 0.0:
        return values, 0.0
    scaled = (times_s - times_s[0]) / np.ptp(times_s)
    table = np.stack([np.ones_like(scaled), scaled], axis=1)
    root = np.sqrt(weights)
    amounts = np.linalg.lstsq(table * root[:, None], values * root, rcond=None)[0]
    line: Array = table @ amounts
    return line, left - float(np.sum(weights * (values - line) ** 2))


GOOD_MISFIT = 1.5
"""A run whose channels all stay below this multiple of their sensors' noise is good."""

Progress = Callable[[str], object]


class NoHealth(Exception):
    """A folder has too few usable logs. The message says why."""

    exit_code = ExitCode.BAD_DATA


@dataclass(frozen=True)
class FollowedDrift:
    """A number that changed."""

    change: NumberDrift
    is_doubtful: bool
    """A misfit grew too: an effect may have moved the number."""


@dataclass(frozen=True)
class RigHealth:
    """The runs of a rig in order, what drifts, and the last good state."""

    runs: tuple[FittedRun, ...]
    refused: tuple[FittedRun, ...]
    drifts: tuple[FollowedDrift, ...]
    good: tuple[FittedRun, ...]
    """The runs that `plant` is the mean of; empty if none is good."""
    plant: PlantSettings | None
    """The last good state."""


def follow_health(
    logs: Sequence[tuple[Path, float]],
    plant: PlantSettings,
    executor: Executor | None = None,
    progress: Progress = lambda line: None,
    stated: Stated = Stated(),
) -> RigHealth:
    """Fit logs, each with its time (s since the epoch), and compare them; raise `NoHealth`."""
    ordered = sorted(logs, key=lambda item: (item[1], item[0].name))
    fit = partial(_fit_one, plant=plant, stated=stated)
    fitted: list[FittedRun] = []
    for run in map(fit, ordered) if executor is None else executor.map(fit, ordered):
        progress(f"{len(fitted) + 1} of {len(ordered)}: {run.name} {run.refused}".rstrip())
        fitted.append(run)
    runs = [run for run in fitted if not run.refused]
    refused = [run for run in fitted if run.refused]
    if len(runs) < 2:
        why = "; ".join(f"{run.name}: {run.refused}" for run in refused[:3])
        raise NoHealth(
            f"{len(runs)} of {len(fitted)} logs can be fitted, two are needed"
            + (f"; {why}" if why else "")
        )
    changes = find_changes(runs)
    grown = {c.name.removesuffix(MISFIT) for c in changes if c.name.endswith(MISFIT)}
    drifts = tuple(
        FollowedDrift(change, bool(grown) and MISFIT not in change.name) for change in changes
    )
    good = _find_last_good(runs, changes)
    return RigHealth(
        tuple(runs), tuple(refused), drifts, tuple(good), _pool_plant(good, plant) if good else None
    )


def _fit_one(log: tuple[Path, float], plant: PlantSettings, stated: Stated) -> FittedRun:
    return fit_log(*log, plant, stated)


def find_changes(runs: Sequence[FittedRun]) -> list[NumberDrift]:
    """Return what changed, the surest first; runs are numbered over all runs."""
    found = []
    for name in dict.fromkeys(name for run in runs for name in run.numbers):
        having = [k for k, run in enumerate(runs) if name in run.numbers]
        numbers = [runs[k].numbers[name] for k in having]
        drift = find_drift(name, numbers, [runs[k].when_s for k in having])
        if drift is not None:
            first, second = having[drift.first], having[drift.second]
            found.append(replace(drift, first=first, second=second))
    return sorted(found, key=lambda one: -one.sigmas)


def _find_last_good(runs: Sequence[FittedRun], changes: Sequence[NumberDrift]) -> list[FittedRun]:
    """Return the latest runs that belong together and that the model explains."""
    ends = sorted({c.second for c in changes if c.kind == "step"} | {0, len(runs)})
    trends = any(c.kind == "trend" for c in changes)
    for first, end in reversed([*pairwise(ends)]):
        good = [run for run in runs[first:end] if _is_good(run)]
        if good:
            return good[-1:] if trends else good
    return []


def _is_good(run: FittedRun) -> bool:
    return all(n.value < GOOD_MISFIT for name, n in run.numbers.items() if name.endswith(MISFIT))


def _pool_plant(runs: Sequence[FittedRun], plant: PlantSettings) -> PlantSettings:
    """Return the plant with the weighted means of the runs' numbers."""
    values = {}
    for name in runs[-1].numbers:
        if not name.endswith(MISFIT):
            numbers = [run.numbers[name] for run in runs if name in run.numbers]
            widths = [max(n.high - n.low, 1e-12 * abs(n.value), 1e-150) for n in numbers]
            weights = 1.0 / np.square(widths)
            values[name] = float(np.average([n.value for n in numbers], weights=weights))
    return with_values(plant, values)
