"""One step of a fit: where the lowest point of the cost is, as a tangent foretells it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.evidence.pool import Unknown

Array = NDArray[np.float64]

MOST_STEP = 3.0
"""Scales that a number may move at once;"""
MOST_GROWN = 0.3
"""or this share of a size, if that is more: its scale is what shows, and many are much larger."""
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-7
"""Of a fit's steps: a narrow valley is followed by hardly damped ones only."""


class Paraboloid:
    """The cost about a model as a tangent foretells it, in scales of the numbers."""

    def __init__(
        self, numbers: Sequence[Unknown], x: Array, d: Array, tangent: Array, slopes: Array
    ) -> None:
        """Stand at the numbers `x`, where the residual is `d`.

        `tangent` holds the change of the residual for a scale of each number; `slopes` are the
        weights of the residual.
        """
        low, high, self.scale, neutral = (
            np.array([getattr(n, k) for n in numbers], dtype=float)  # nan of what is no size
            for k in ("low", "high", "scale", "neutral")
        )
        self.x, self.low, self.high = x, low, high
        most = np.fmax(MOST_STEP, MOST_GROWN * np.abs(x - neutral) / self.scale)
        self.least = np.maximum(-most, (low - x) / self.scale)
        self.most = np.minimum(most, (high - x) / self.scale)
        self.flat = tangent.reshape(len(x), -1)
        self.weighed = self.flat * slopes.ravel()
        self.hessian, self.slope = self.weighed @ self.flat.T, self.weighed @ d.ravel()
        out = ((x <= low) & (self.slope > 0.0)) | ((x >= high) & (self.slope < 0.0))
        self.free = np.flatnonzero(~out & (np.diag(self.hessian) > 0.0))
        """What may move: numbers whose gradient points out of their range stay."""
        self.inside = self.free

    def step(self, damping: float) -> Array:
        """Return a damped step in the box of `most` scales and of the ranges.

        Where a number meets a side of the box it stays, and the others go on beside it.
        """
        go, self.inside = np.zeros(len(self.x)), self.free
        while len(self.inside):
            way = self._solve(self.slope + self.hessian @ go, damping)
            ahead = np.where(way > 0.0, self.most, self.least) - go
            shares = np.divide(ahead, way, out=np.ones_like(way), where=way != 0.0)
            share = min(1.0, float(shares[self.inside].min()))
            go = np.clip(go + share * way, self.least, self.most)
            if share == 1.0:
                break
            self.inside = self.inside[shares[self.inside] > share]
        return go

    def bend(self, go: Array, change: Array, damping: float) -> Array:
        """Return the last step along a bent way.

        What it changed, and the tangent did not foretell, is the residual's second derivative along
        it (geodesic acceleration).
        """
        bent = go + self._solve(self.weighed @ (change - go @ self.flat), damping)
        ends = (self.low - self.x) / self.scale, (self.high - self.x) / self.scale
        return np.asarray(np.clip(bent, *ends))

    def move(self, go: Array) -> Array:
        """Return the numbers behind a step, inside their ranges."""
        return np.asarray(np.clip(self.x + go * self.scale, self.low, self.high))

    def promise(self, go: Array) -> float:
        """Return what a step gains if the tangent holds."""
        return float(-(self.slope @ go) - 0.5 * go @ self.hessian @ go)

    def correct(self, go: Array, change: Array) -> None:
        """Let the tangent foretell what a step changed (Broyden)."""
        missed = change - go @ self.flat
        self.flat += np.outer(go / max(float(go @ go), 1e-30), missed)

    def _solve(self, slope: Array, damping: float) -> Array:
        """Return the way of the numbers inside to where a slope ends; the others stay."""
        way, its = np.zeros(len(self.x)), self.inside
        if len(its):
            size = np.sqrt(np.diag(self.hessian))  # in which no scale of a number makes it singular
            least = 1e-12 * size.max() ** 2 * np.eye(len(its))
            curved = (self.hessian[np.ix_(its, its)] + least) / np.outer(size[its], size[its])
            slow = slope[its] / size[its]
            way[its] = -np.linalg.solve(curved + damping * np.eye(len(its)), slow) / size[its]
        return way
