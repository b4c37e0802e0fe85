"""How sure a fitted number is, honestly under residuals that remember.

What noise does to a number is seen in the self-simulated replicas: its scatter and, since friction
rectifies noise, its bias. They are few, so that their scatter is one of a sample (Student's t).
What a wrong form does is in the residual: its scores, summed over seconds because neighbours are
no news (a sandwich). What the integrator does is in a simulation with half its sub-step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from pamctl.diagnose.fitting.block_fit import Fit
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import Floor
from pamctl.diagnose.fitting.integrator import find_substep_shift
from pamctl.diagnose.fitting.numbers import unit_of
from pamctl.diagnose.measured.record import Array

STRETCH_S = 1.0


@dataclass(frozen=True)
class FittedNumber:
    """A fitted number with its 90 % interval."""

    name: str
    value: float
    low: float
    high: float
    unit: str

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        return {"value": self.value, "ci90": [self.low, self.high], "unit": self.unit}


def estimate_intervals(model: Model) -> tuple[FittedNumber, ...]:
    """Return every free number of a model with its interval; the geometry is the mechanics'."""
    found: dict[str, FittedNumber] = {}
    for block in sorted(model.evidence.blocks, reverse=True):
        fitted = model.fit_of(block)
        floors = [model.floors[b] for b in model.evidence.blocks if model.fit_of(b) is fitted]
        for name, estimate in _estimate_of_fit(fitted, floors).items():
            found.setdefault(name, estimate)
    return tuple(found.values())


def _estimate_of_fit(fitted: Fit, floors: list[Floor]) -> dict[str, FittedNumber]:
    """Return every free number of a fit with its interval, within its range."""
    if not fitted.free:
        return {}
    halves = np.sqrt(
        np.maximum(_squared_width_of_residual(fitted), _squared_width_of_noise(fitted, floors))
        + _squared_width_of_step(fitted)
    )
    found = {}
    for number, half in zip(fitted.free, map(float, halves), strict=True):
        if number.is_nuisance:
            continue
        value = fitted.values[number.name]
        found[number.name] = FittedNumber(
            number.name,
            value,
            max(value - half * number.scale, number.low),
            min(value + half * number.scale, number.high),
            unit_of(number),
        )
    return found


def _squared_width_of_noise(fitted: Fit, floors: list[Floor]) -> Array:
    """Half width, squared, for what noise does to a number: of the worse of the blocks' floors."""
    squares = np.zeros(len(fitted.free))
    for floor in floors:
        shifts = floor.shifts
        if shifts.shape[1] != len(fitted.free):
            continue  # of a rougher model, where a block is far above any floor
        count = len(shifts)
        scatter = shifts.var(axis=0, ddof=1) * (1.0 + 1.0 / count)
        bias = shifts.mean(axis=0) ** 2
        found = _quantile(count - 1) ** 2 * scatter + _quantile(np.inf) ** 2 * bias
        squares = np.maximum(squares, found)
    return squares


def _squared_width_of_step(fitted: Fit) -> Array:
    """Half width, squared, for what the integrator's sub-step does to a number."""
    return _quantile(np.inf) ** 2 * find_substep_shift(fitted) ** 2


def _quantile(freedom: float) -> float:
    """Student's t that nine of ten stay below on either side."""
    return float(student.ppf(0.95, freedom))


def _squared_width_of_residual(fitted: Fit) -> Array:
    """Half width, squared, from the scores of the residual, stretch by stretch."""
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
