"""The score test: how much of the residual can an effect explain, to first order?

A dose of the effect is simulated, and what recalibration can imitate of it is projected out. The
rest is compared with the residual. This takes one simulation per dose instead of a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from pamctl.diagnose.fitting.block_fit import Fit, find_secants, project_out
from pamctl.diagnose.fitting.candidates import Candidate, generate_doses
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.measured.record import Array
from pamctl.plant.model import PlantSettings


@dataclass(frozen=True)
class Score:
    """How much a candidate promises to explain."""

    candidate: Candidate
    explained: float
    """Share of the residual's square that it explains after recalibration."""
    start: dict[str, float]
    """Numbers from which its fit should start."""


_KNOWN: WeakKeyDictionary[Fit, dict[tuple[Candidate, str], Score]] = WeakKeyDictionary()
"""By fit, candidate and block: the same recalibrated block is scored more than once."""


def score_candidates(fitted: Fit, candidates: Sequence[Candidate], block: str) -> list[Score]:
    """Score candidates by what they explain of a block on a fit's own drives, the best first.

    A fit of both blocks counts with all its rows: shared geometry may explain nothing of one
    block that the other block contradicts.
    """
    rows = np.concatenate([np.full(d.samples, d.block == block) for d in fitted.drives])
    known = _KNOWN.setdefault(fitted, {})
    unscored = [candidate for candidate in candidates if (candidate, block) not in known]
    if unscored:
        basis = find_movable_basis(fitted)
        left = project_out(basis, fitted.residual)
        for candidate in unscored:
            known[candidate, block] = _score_candidate(fitted, basis, left, rows, candidate)
    return sorted((known[candidate, block] for candidate in candidates), key=lambda s: -s.explained)


def find_movable_basis(fitted: Fit) -> Array:
    """Return an orthonormal basis of what recalibration can still change, shape (n, at most p).

    A number at an end of its range is left out: what pulls it there may be an effect.
    """
    bound = fitted.at_bound
    movable = [index for index, free in enumerate(fitted.free) if free.name not in bound]
    if not movable:
        return np.zeros((len(fitted.residual), 0))
    basis: Array = np.linalg.qr(fitted.jacobian[:, movable])[0]
    return basis


def _score_candidate(
    fitted: Fit, basis: Array, left: Array, rows: NDArray[np.bool_], candidate: Candidate
) -> Score:
    best = Score(candidate, 0.0, {})
    for doses in generate_doses(candidate, fitted.settings):
        secants = find_secants(fitted, doses)
        secants = project_out(basis, secants)
        amounts = fit_amounts(secants, left, dose_range(candidate, fitted.settings, doses))
        rest = (left - secants @ amounts)[rows]
        explained = 1.0 - float(np.sum(rest**2) / np.sum(left[rows] ** 2))
        if explained > best.explained:
            best = Score(
                candidate, explained, choose_start(candidate, fitted.settings, doses, amounts)
            )
    return best


def fit_amounts(secants: Array, left: Array, bounds: tuple[Array, Array]) -> Array:
    """Return by least squares how much of each dose fits, within the numbers' ranges."""
    triangle: Array = np.asarray(np.linalg.qr(np.column_stack([secants, left]), mode="r"))
    size = secants.shape[1]
    amounts: Array = lsq_linear(triangle[:size, :size], triangle[:size, size], bounds).x
    return amounts


def dose_range(
    candidate: Candidate, settings: PlantSettings, doses: Sequence[dict[str, float]]
) -> tuple[Array, Array]:
    """Return the least and the most doses of each switch that its range allows."""
    low, high = [], []
    for number, dose in zip(candidate.switches, doses, strict=True):
        neutral = value_of(settings, number.name)
        step = dose[number.name] - neutral
        ends = sorted(((number.low - neutral) / step, (number.high - neutral) / step))
        low.append(min(ends[0], 0.0) - 1e-9)
        high.append(max(ends[1], 0.0) + 1e-9)
    return np.array(low), np.array(high)


def choose_start(
    candidate: Candidate,
    settings: PlantSettings,
    doses: Sequence[dict[str, float]],
    amounts: Array,
) -> dict[str, float]:
    """Return the start that the amounts suggest, off the ends of the ranges."""
    start = dict(doses[0])
    for number, dose, amount in zip(candidate.switches, doses, amounts, strict=True):
        neutral = value_of(settings, number.name)
        value = neutral + amount * (dose[number.name] - neutral)
        start[number.name] = clip_inside(value, number.low, number.high, number.scale)
    return start


def clip_inside(value: float, low: float, high: float, scale: float) -> float:
    """Return the value, kept a fifth of a visible step away from the ends of its range."""
    edge = min(0.2 * scale, 0.1 * (high - low))
    return float(np.clip(value, low + edge, high - edge))
