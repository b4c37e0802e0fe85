"""Tell whether one residual is really smaller than another, against the scatter of stretches.

Neighbouring samples are nearly equal, so whole stretches are drawn again and again (a paired block
bootstrap). A difference that a few stretches make alone does not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.measured.record import Array

STRETCH_S = 0.25
"""Residuals this far apart count as independent."""
MOST_STRETCHES = 100
"""A long record is cut in longer stretches: slow rigs have slow residuals."""
FEWEST_SAMPLES = 8
REPLICAS = 400
MUCH = 0.05
"""A difference of the logs of two mean squares that matters."""
SURE = 0.02
"""Share of the replicas that may say otherwise."""


def average_squares(residual: Array, period_s: float) -> Array:
    """Return the mean squares of the stretches of a residual, shape (m,)."""
    longest = max(len(residual) // MOST_STRETCHES, FEWEST_SAMPLES)
    length = min(max(int(STRETCH_S / period_s), longest), len(residual))
    whole = residual[: len(residual) // length * length]
    means: Array = (whole.reshape(-1, length) ** 2).mean(axis=1)
    return means


def average_block_squares(model: Model, block: str) -> Array:
    """Return the held-out mean squares of a block's stretches, in squared deviations."""
    period_s = float(np.median(model.evidence.holdout[block][0].step_s))
    return average_squares(model.residuals[block], period_s)


def average_squares_over_floor(model: Model, blocks: Sequence[str]) -> Array:
    """Return the same for several blocks, each in units of its floor, shape (m,)."""
    return np.concatenate(
        [average_block_squares(model, b) / model.floors[b].mean ** 2 for b in blocks]
    )


def draw_means(*rows: Array) -> Array:
    """Return bootstrap replicas of the rows' means, drawn alike, shape (rows, REPLICAS)."""
    squares = np.array(rows)
    picks = np.random.default_rng(7).integers(0, squares.shape[1], (REPLICAS, squares.shape[1]))
    means: Array = squares[:, picks].mean(axis=2)
    return means


def is_clearly_less(less: Array, more: Array, much: float = MUCH) -> bool:
    """Tell whether the mean of `less` is really below that of `more`, both by stretches."""
    return find_sure_difference(less, more) > much


def find_sure_difference(less: Array, more: Array) -> float:
    """Return by how much the logs of two means surely differ: the scatter's low end."""
    small, large = draw_means(less, more)
    return float(np.quantile(np.log(large) - np.log(small), SURE))


def is_clearly_above(squares: Array, limit: float) -> bool:
    """Tell whether a residual is really above a limit of its RMS."""
    (means,) = draw_means(squares)
    return float(np.quantile(means, SURE)) > limit**2


def gains_in_block(before: Model, model: Model, block: str) -> bool:
    """Tell whether a model really leaves less of a block than another does."""
    return is_clearly_less(
        average_block_squares(model, block), average_block_squares(before, block)
    )
