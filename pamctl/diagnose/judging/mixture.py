"""Tell two models apart that are not nested: ask the data for the best mixture of both.

Where one of them is true, the best mixture is that one alone, however near the other one comes to
it (the J test of Davidson and MacKinnon, 1981). Whether the other leaves much more does not matter,
as the noise of both residuals is the same and falls out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.measured.record import Array

STRETCH_S = 0.5
"""Products of residuals this far apart count as independent."""
REPLICAS = 400
SURE = 0.02
"""Share of the replicas on either side of the interval."""
FAR = 0.02
"""Least mean square between two simulations, in squared floors: what nobody models may be nearer.
"""
NEARLY_ALL = 0.7
"""Share of a mixture that leaves nothing for the other model."""


@dataclass(frozen=True)
class Mixture:
    """The mixture of two models that leaves least of a block."""

    low: float
    """Low end of the second model's share; 0 stands for the first alone, 1 for the second."""
    high: float
    distance: float
    """Mean square between both simulations, in squared floors."""

    @property
    def is_first(self) -> bool:
        """Tell whether the data refute the second model beside the first."""
        return self.distance > FAR and self.high < 1.0 - NEARLY_ALL

    @property
    def is_second(self) -> bool:
        """Tell whether the data refute the first model beside the second."""
        return self.distance > FAR and self.low > NEARLY_ALL


def mix_models(one: Array, other: Array, period_s: float) -> Mixture:
    """Return the best mixture of two models, from their residuals in floors, by a bootstrap."""
    products = _multiply(one, one - other, period_s)
    picks = np.random.default_rng(13).integers(0, len(products), (REPLICAS, len(products)))
    along, square = products[picks].mean(axis=1).T
    shares = along / np.maximum(square, 1e-30)
    low, high = np.quantile(shares, [SURE, 1.0 - SURE])
    return Mixture(float(low), float(high), float(products[:, 1].mean()))


def _multiply(residual: Array, between: Array, period_s: float) -> Array:
    """Return what the residual has along the way to the other model, and the square of that way.

    Both are means of stretches, shape (stretches, 2).
    """
    length = min(max(int(STRETCH_S / period_s), 1), len(residual))
    count = len(residual) // length
    both = np.stack([residual * between, between**2])[:, : count * length]
    means: Array = both.reshape(2, count, length).mean(axis=2).T
    return means


def is_first_alone(mixtures: Iterable[Mixture]) -> bool:
    """Tell whether the second of two models is refuted in a block, and the first in none."""
    by_block = [*mixtures]
    return any(m.is_first for m in by_block) and not any(m.is_second for m in by_block)


def is_second_alone(mixtures: Iterable[Mixture]) -> bool:
    """Tell whether the first of two models is refuted in a block, and the second in none."""
    by_block = [*mixtures]
    return any(m.is_second for m in by_block) and not any(m.is_first for m in by_block)
