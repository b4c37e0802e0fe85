"""A number over runs: constant, a step between two runs, or a trend.

The intervals of the fits weigh the values. Runs may scatter by more than their intervals say: then
all are widened, by what neighbours differ. A change counts where it explains far more than the
best of all places would by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.plant_numbers import FittedNumber

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
