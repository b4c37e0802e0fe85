"""Intervals of fitted numbers, for autocorrelated residuals.

Three sources add up. Noise: the self-simulated replicas show its scatter and, since friction
rectifies noise, its bias; they are few, hence Student's t. A wrong form: the scores of the
residual show it, summed over seconds because neighbours are correlated (a sandwich estimate).
The integrator: a simulation with half its sub-step shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri, stdtrit

from pamctl.diagnose.fitting.block_fit import Fit
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import Floor
from pamctl.diagnose.fitting.integrator import find_substep_shift
from pamctl.diagnose.fitting.numbers import unit_of
from pamctl.diagnose.measured.record import Array

STRETCH_S = 1.0
"""Scores are summed over stretches of this length."""


@dataclass(frozen=True)
class FittedNumber:
    """A fitted number with its 90 % interval."""

    name: str
    value: float
    low: float
    high: float
    unit: str
    conditional_on: tuple[str, ...] = ()
    """Effects that the interval takes for granted, where something else is left or possible."""

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        known = {"value": self.value, "ci90": [self.low, self.high], "unit": self.unit}
        return {**known, "conditional_on": [*self.conditional_on]} if self.conditional_on else known


def estimate_intervals(model: Model) -> tuple[FittedNumber, ...]:
    """Return every free number of a model with its interval; the mechanics decide the geometry."""
    estimates: dict[str, FittedNumber] = {}
    for block in sorted(model.evidence.blocks, reverse=True):
        fitted = model.fit_of(block)
        floors = [model.floors[b] for b in model.evidence.blocks if model.fit_of(b) is fitted]
        for name, estimate in _estimate_of_fit(fitted, floors).items():
            estimates.setdefault(name, estimate)
    return tuple(estimates.values())


def widen_by_forms(
    numbers: Sequence[FittedNumber], others: Sequence[Model]
) -> tuple[FittedNumber, ...]:
    """Widen intervals to hold what other models say, which may be true as well."""
    widened = []
    for number in numbers:
        values = [number.low, number.high]
        values += [m.values[number.name] for m in others if number.name in m.values]
        widened.append(replace(number, low=min(values), high=max(values)))
    return tuple(widened)


def _estimate_of_fit(fitted: Fit, floors: list[Floor]) -> dict[str, FittedNumber]:
    """Return every free number of a fit with its interval, within its range."""
    if not fitted.free:
        return {}
    halves = np.sqrt(
        np.maximum(_squared_width_of_residual(fitted), _squared_width_of_noise(fitted, floors))
        + _squared_width_of_step(fitted)
    )
    estimates = {}
    for number, half in zip(fitted.free, map(float, halves), strict=True):
        if number.is_nuisance:
            continue
        value = fitted.values[number.name]
        estimates[number.name] = FittedNumber(
            number.name,
            value,
            max(value - half * number.scale, number.low),
            min(value + half * number.scale, number.high),
            unit_of(number),
        )
    return estimates


def _squared_width_of_noise(fitted: Fit, floors: list[Floor]) -> Array:
    """Return the squared half widths that noise causes, from the worse of the blocks' floors."""
    squares = np.zeros(len(fitted.free))
    for floor in floors:
        shifts = floor.shifts
        if shifts.shape[1] != len(fitted.free):
            continue  # the floor of the recalibrated model, for a block far above any floor
        count = len(shifts)
        scatter = shifts.var(axis=0, ddof=1) * (1.0 + 1.0 / count)
        bias = shifts.mean(axis=0) ** 2
        square = _quantile(count - 1) ** 2 * scatter + _quantile(np.inf) ** 2 * bias
        squares = np.maximum(squares, square)
    return squares


def _squared_width_of_step(fitted: Fit) -> Array:
    """Return the squared half widths that the integrator's sub-step causes."""
    return _quantile(np.inf) ** 2 * find_substep_shift(fitted) ** 2


def _quantile(freedom: float) -> float:
    """Return the 95 % quantile of Student's t: 90 % lie within it on both sides."""
    return float(stdtrit(freedom, 0.95) if np.isfinite(freedom) else ndtri(0.95))


def _squared_width_of_residual(fitted: Fit) -> Array:
    """Return the squared half widths from the residual's scores, summed by stretches."""
    slope, residual = fitted.jacobian, fitted.residual
    bread = np.linalg.pinv(slope.T @ slope)
    filling = np.zeros_like(bread)
    pieces = 0
    start = 0
    for drive in fitted.drives:
        end = start + drive.samples
        length = max(int(STRETCH_S / float(np.median(drive.step_s))), 1)
        for begin in range(start, end, length):
            stop = min(begin + length, end)
            score = slope[begin:stop].T @ residual[begin:stop]
            filling += np.outer(score, score)
            pieces += 1
        start = end
    spare = max(pieces - slope.shape[1], 1)
    covariance = bread @ filling @ bread * (pieces / spare)
    return _quantile(spare) ** 2 * np.asarray(np.diag(covariance))
