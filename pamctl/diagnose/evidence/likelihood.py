"""The likelihood: residual -> Haar coefficients by block -> Student-t with a scale for each level.

    l(d) = sum_cj sum_i [ (nu + 1) / 2 log(1 + d_i^2 / (nu s_cj^2)) + log s_cj ]
    s_cj^2 = max( fixed point of mean((nu + 1) d^2 / (nu + d^2 / s^2)), floor_c^2, K^2 ms_c )

The transform is orthonormal: white noise stays white, and the coefficients of one level are nearly
independent for any residual like 1/f. c is a channel, j a level, K the NUGGET, ms_c the mean square
of the channel's residual. What is masked is filled from its neighbours, in every model alike, and
coefficients that hold mostly filled samples do not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.evidence.constants import NU, NUGGET

Array = NDArray[np.float64]
ROOT_HALF = 0.7071067811865476
MOST_IN_SCALE = 2048
"""Coefficients that a scale is made of: more would not change it."""
PRODUCT = 16
"""Factors under one logarithm."""
FARTHEST = 1e15
"""Of a squared coefficient over its scale; a run that left the model's range is that far."""


class Loss(NamedTuple):
    """What a residual costs."""

    by_block: Array
    """Nats of each block, shape (n_blocks,)."""
    weights: Array
    """Weight of each coefficient in a least-squares step, as the coefficients."""
    scales2: Array
    """Squared scales, shape (channels, levels + 1)."""


def to_haar(blocks: Array) -> Array:
    """Transform along the last axis, of 2**levels samples: finest level first, the mean last."""
    parts, rest = [], blocks
    while rest.shape[-1] > 1:
        even, odd = rest[..., 0::2], rest[..., 1::2]
        parts.append((even - odd) * ROOT_HALF)
        rest = (even + odd) * ROOT_HALF
    return np.concatenate([*parts, rest], axis=-1)


def from_haar(coefficients: Array) -> Array:
    """Undo `to_haar`."""
    size = coefficients.shape[-1]
    rest, end = coefficients[..., size - 1 :], size - 1
    while rest.shape[-1] < size:
        part = coefficients[..., end - rest.shape[-1] : end]
        end -= rest.shape[-1]
        wider = np.empty((*rest.shape[:-1], 2 * rest.shape[-1]))
        wider[..., 0::2] = (rest + part) * ROOT_HALF
        wider[..., 1::2] = (rest - part) * ROOT_HALF
        rest = wider
    return rest


def levels_of(block: int) -> NDArray[np.int64]:
    """Return the level of each coefficient of a block, 0 for the finest; the mean has its own."""
    levels = block.bit_length() - 1
    return np.repeat(np.arange(levels + 1), [*(block >> j for j in range(1, levels + 1)), 1])


@dataclass
class Likelihood:
    """-log p of Haar coefficients, shape (channels, n_blocks, block)."""

    keep: NDArray[np.bool_]
    """Which coefficients count, as the coefficients."""
    least2: Array
    """Squared resolution of each channel's sensor, shape (channels,)."""

    def __post_init__(self) -> None:
        """Lay out the levels."""
        self.channels, self.n_blocks, self.block = self.keep.shape
        self.level = levels_of(self.block)
        self.n_levels = int(self.level[-1]) + 1
        self.counts = np.stack(
            [np.bincount(self.level, kept.sum(axis=0), self.n_levels) for kept in self.keep]
        )
        self.all_kept = bool(self.keep.all())
        self._lay_out_samples()

    def _lay_out_samples(self) -> None:
        """Choose what each scale is made of: at most MOST_IN_SCALE coefficients, evenly."""
        chosen = [
            np.flatnonzero((self.keep[c] & (self.level == j)).ravel())
            for c in range(self.channels)
            for j in range(self.n_levels)
        ]
        chosen = [i[:: max(1, len(i) // MOST_IN_SCALE)] for i in chosen]
        width = max(map(len, chosen))
        size = self.n_blocks * self.block
        self._at = np.zeros((len(chosen), width), dtype=np.int64)
        self._counted = np.zeros((len(chosen), width))
        for row, i in enumerate(chosen):
            self._at[row, : len(i)] = i + size * (row // self.n_levels)
            self._counted[row, : len(i)] = 1.0 / max(len(i), 1)

    def mean_squares(self, d: Array) -> Array:
        """Return the mean square of each channel's coefficients."""
        squares = d * d if self.all_kept else np.where(self.keep, d * d, 0.0)
        return np.asarray(squares.sum(axis=(1, 2)) / np.maximum(self.counts.sum(axis=1), 1.0))

    def find_scales2(self, d: Array, floor2: Array, start: Array | None = None) -> Array:
        """Return the squared scales that maximise the likelihood, not below their floors."""
        least = np.maximum(floor2, NUGGET**2 * self.mean_squares(d))
        least = np.repeat(np.maximum(least, self.least2), self.n_levels)[:, None]
        q = np.minimum(d.reshape(-1)[self._at] ** 2, FARTHEST * least)
        s = (
            (q * self._counted).sum(axis=1, keepdims=True)
            if start is None
            else start.reshape(-1, 1)
        )
        s = np.maximum(s, least)
        share, counted = np.empty_like(q), (NU + 1.0) * self._counted
        for _ in range(8 if start is None else 4):
            np.divide(q, s, out=share)
            share += NU
            np.divide(q, share, out=share)
            s = np.maximum(np.einsum("ij,ij->i", share, counted)[:, None], least)
        return s.reshape(self.channels, self.n_levels)

    def __call__(
        self, d: Array, floor2: Array, start: Array | None = None, scales2: Array | None = None
    ) -> Loss:
        """Weigh coefficients; `floor2` is that of the poorer model, shape (channels,)."""
        if scales2 is None:
            scales2 = self.find_scales2(d, floor2, start)
        inverse = 1.0 / scales2[:, self.level]
        q = d * d
        q *= inverse[:, None, :]
        np.minimum(q, FARTHEST, out=q)
        q += NU
        weights = (NU + 1.0) * inverse[:, None, :] / q
        if not self.all_kept:
            weights *= self.keep
            q[~self.keep] = NU
        q *= 1.0 / NU
        logs = np.log(q.reshape(self.channels, self.n_blocks, -1, PRODUCT).prod(axis=-1))
        by_block = 0.5 * (NU + 1.0) * logs.sum(axis=(0, 2))
        half_logs = 0.5 * np.log(scales2)[:, self.level]
        if self.all_kept:
            by_block += half_logs.sum()
        else:
            by_block += np.einsum("cbi,ci->b", self.keep, half_logs)
        return Loss(by_block, weights, scales2)

    def find_slopes(self, d: Array, loss: Loss, floor2: Array) -> Array:
        """Return the weights w with which the slope of the loss is w d: those of a step.

        Where scales stand at the share NUGGET of a channel's whole misfit s = NUGGET^2 sum d^2 / n,
        each coefficient also raises all of these: by dL/ds 2 NUGGET^2 / n, as a square does. By
        its own weight alone, a step would gain on small coefficients, and lose more by the floor.
        """
        more = np.zeros(self.channels)
        least2 = NUGGET**2 * self.mean_squares(d)
        for c in np.flatnonzero(least2 > (1.0 - 1e-9) * np.maximum(floor2, self.least2)):
            scales2 = loss.scales2[c]
            small = np.bincount(self.level, (loss.weights[c] * d[c] ** 2).sum(axis=0))
            rise = 0.5 * (self.counts[c] - small) / scales2
            total = rise[scales2 <= (1.0 + 1e-9) * least2[c]].sum()
            more[c] = 2.0 * NUGGET**2 / self.counts[c].sum() * max(total, 0.0)
        return loss.weights + more[:, None, None] * self.keep if more.any() else loss.weights
