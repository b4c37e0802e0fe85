"""Least squares for a few numbers and very many samples.

It is the dogleg in a box of Voglis and Lagaris (2004), as `scipy.optimize.least_squares` has it
(`method="dogbox"`, `loss="soft_l1"`), and takes the same steps. But it works with the normal
equations, of the size of the numbers instead of the samples, and asks for no derivatives where it
ends: with ten numbers and 60000 samples scipy's own work costs as much as the simulations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_GRADIENT = 1e-10
LEAST_STEP = 1e-6
"""A step that is shorter than this share of the vector ends the descent."""
NEARLY = 1e-12
"""Directions in which the residual changes by less, as a share of the most, in squares, stay."""


class DescentEnd(Enum):
    """Why a descent ended."""

    EVALUATIONS = "it has used up its evaluations"
    LEVEL = "the cost hardly falls, or the slope is zero"
    STUCK = "steps became too small on a slope"


@dataclass(frozen=True)
class Descent:
    """Where a descent ended."""

    vector: Array
    cost: float
    ending: DescentEnd


class _Quadratic:
    """The cost around a point: soft_l1 of the residual, linearised."""

    def __init__(self, residual: Array, jacobian: Array, knee: float) -> None:
        square = (residual / knee) ** 2
        slope = 1.0 / np.sqrt(1.0 + square)
        # Weights of the squares of derivatives; scipy's `scale_for_robust_loss_function`.
        weight = np.maximum(slope - square * slope**3, np.finfo(float).eps)
        self.square = jacobian.T @ (weight[:, None] * jacobian)
        self.gradient: Array = jacobian.T @ (slope * residual)

    def change(self, step: Array) -> float:
        """Return the cost's change that a step promises."""
        return float(self.gradient @ step + 0.5 * step @ self.square @ step)


def measure_cost(residual: Array, knee: float) -> float:
    """Return half the sum of soft_l1: squares up to the knee, linear far above it."""
    return float(knee**2 * np.sum(np.sqrt(1.0 + (residual / knee) ** 2) - 1.0))


def descend(
    residual_at: Callable[[Array], Array],
    jacobian_at: Callable[[Array], Array],
    start: Array,
    low: Array,
    high: Array,
    *,
    knee: float,
    tolerance: float,
    evaluations: int,
) -> Descent:
    """Minimise the cost of a residual from `start`, within `low` and `high`.

    Residuals above `knee` count linearly. It ends when a step reduces the cost by less than the
    share `tolerance`, or after `evaluations` of the residual.
    """
    here, radius = start.copy(), float(np.max(np.abs(start))) or 1.0
    residual = residual_at(here)
    cost, left = measure_cost(residual, knee), evaluations - 1
    side = np.where(here == low, -1, np.where(here == high, 1, 0))
    while left > 0:
        model = _Quadratic(residual, jacobian_at(here), knee)
        free = side * model.gradient >= 0.0
        if not free.any() or np.max(np.abs(model.gradient[free])) < LEAST_GRADIENT:
            return Descent(here, cost, DescentEnd.LEVEL)
        gained, ending = -1.0, None
        while gained <= 0.0 and left > 0 and ending is None:
            step, hit, is_cut = _dogleg(model, here, radius, low, high, free)
            there = np.clip(here + step, low, high)
            new = residual_at(there)
            left -= 1
            cost_there = measure_cost(new, knee)
            gained, promised = cost - cost_there, -model.change(step)
            ratio = gained / promised if promised > 0.0 else float(gained == promised == 0.0)
            if ratio < 0.25:
                radius = 0.25 * float(np.max(np.abs(step)))
            elif ratio > 0.75 and is_cut:
                radius *= 2.0
            if gained < tolerance * cost and ratio > 0.25:
                ending = DescentEnd.LEVEL
            elif np.linalg.norm(step) < LEAST_STEP * (LEAST_STEP + np.linalg.norm(here)):
                ending = DescentEnd.STUCK
        if gained > 0.0:
            side[free] = hit[free]
            here = np.where(side < 0, low, np.where(side > 0, high, there))
            residual, cost = new, cost_there
        if ending is not None:
            return Descent(here, cost, ending)
    return Descent(here, cost, DescentEnd.EVALUATIONS)


def _dogleg(
    model: _Quadratic,
    here: Array,
    radius: float,
    low: Array,
    high: Array,
    free: NDArray[np.bool_],
) -> tuple[Array, NDArray[np.int64], bool]:
    """Return the step, the bounds that it hits (-1, 0, 1), and whether the radius cut it.

    The step is Gauss and Newton's if that stays inside the box, else a way that begins along the
    gradient and turns towards it.
    """
    least, most = np.maximum(low - here, -radius), np.minimum(high - here, radius)
    downhill = np.where(free, -model.gradient, 0.0)
    newton = np.zeros_like(here)
    newton[free] = _solve(model.square[np.ix_(free, free)], downhill[free])
    hit = np.zeros(len(here), dtype=np.int64)
    if np.all((newton >= least) & (newton <= most)):
        return newton, hit, False
    bend, longest = 0.5 * float(downhill @ model.square @ downhill), _reach(downhill, least, most)
    best = float(downhill @ downhill) / (2.0 * bend) if bend > 0.0 else longest
    first = min(best, longest) * downhill
    turn = newton - first
    size = _reach(turn, least - first, most - first)
    step = first + size * turn
    ends = np.where(turn < 0.0, least, most)
    at_end = free & (turn != 0.0) & (np.abs(step - ends) <= 1e-12 * np.abs(ends))
    at_bound = at_end & (ends == np.where(turn < 0.0, low - here, high - here))
    hit[at_bound] = np.sign(turn[at_bound]).astype(np.int64)
    return step, hit, bool(np.any(at_end & ~at_bound))


def _solve(square: Array, right: Array) -> Array:
    """Solve the normal equations, with columns of one size; directions without effect stay."""
    size = np.sqrt(np.maximum(np.diag(square), np.finfo(float).tiny))
    inverse = np.linalg.pinv(square / np.outer(size, size), rcond=NEARLY, hermitian=True)
    solution: Array = inverse @ (right / size) / size
    return solution


def _reach(way: Array, least: Array, most: Array) -> float:
    """Return how many times a way fits into a box around its start."""
    moves = way != 0.0
    ends = np.where(way < 0.0, least, most)[moves]
    return float(np.min(ends / way[moves], initial=np.inf))
