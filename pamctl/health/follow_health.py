"""The health of a rig over a folder of logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from pamctl.diagnose.plant_numbers import with_values
from pamctl.exit_codes import ExitCode
from pamctl.health.find_drift import SIGMAS_OF_CI90, NumberDrift, find_drift
from pamctl.health.fit_run import MISFIT, FittedRun, fit_halves, fit_log
from pamctl.plant.model import PlantSettings

GOOD_MISFIT = 1.5
"""A run whose channels all stay below this multiple of their sensors' noise is good."""
LATEST_FOR_HALVES = 3
SURE_WITHIN = 3.0
"""A change within runs counts from this multiple of its uncertainty on."""

Progress = Callable[[str], object]


class NoHealth(Exception):
    """A folder has too few usable logs. The message says why."""

    exit_code = ExitCode.BAD_DATA


@dataclass(frozen=True)
class FollowedDrift:
    """A number that changed, and whether it changes within runs too."""

    change: NumberDrift
    within: bool | None
    """True: it changes within runs; False: from run to run only; None: the runs do not tell."""
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
) -> RigHealth:
    """Fit logs, each with its time (s since the epoch), and compare them; raise `NoHealth`."""
    ordered = sorted(logs, key=lambda item: (item[1], item[0].name))
    fit = partial(_fit_one, plant=plant)
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
    paths = {path.name: path for path, _ in ordered}
    halves = _fit_latest_halves(runs, paths, plant) if changes else []
    grown = {c.name.removesuffix(MISFIT) for c in changes if c.name.endswith(MISFIT)}
    drifts = tuple(
        FollowedDrift(
            change, _changes_within(change, halves), bool(grown) and MISFIT not in change.name
        )
        for change in changes
    )
    good = _find_last_good(runs, changes)
    return RigHealth(
        tuple(runs), tuple(refused), drifts, tuple(good), _pool_plant(good, plant) if good else None
    )


def _fit_one(log: tuple[Path, float], plant: PlantSettings) -> FittedRun:
    return fit_log(*log, plant)


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


def _fit_latest_halves(
    runs: Sequence[FittedRun], paths: dict[str, Path], plant: PlantSettings
) -> list[tuple[FittedRun, FittedRun]]:
    latest = [fit_halves(paths[run.name], plant) for run in runs[-LATEST_FOR_HALVES:]]
    return [pair for pair in latest if pair is not None]


def _changes_within(
    change: NumberDrift, halves: Sequence[tuple[FittedRun, FittedRun]]
) -> bool | None:
    """Tell whether the latest runs change the number from their first half to their second."""
    moved, squares = [], []
    for first, second in halves:
        if change.name in first.numbers and change.name in second.numbers:
            a, b = first.numbers[change.name], second.numbers[change.name]
            moved.append(b.value - a.value)
            squares.append((a.high - a.low) ** 2 + (b.high - b.low) ** 2)
    if not moved:
        return None
    sigma = float(np.sqrt(np.mean(squares) / len(squares))) / (2.0 * SIGMAS_OF_CI90)
    mean = float(np.mean(moved))
    size = abs(change.after - change.before)
    if abs(mean) > SURE_WITHIN * sigma and mean * (change.after - change.before) > 0.0:
        return True
    return False if SURE_WITHIN * sigma < 0.5 * size else None


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
