"""Models under the likelihood: their fit, their evidence with each block left out, what counts.

A fit compares simulations of coarse steps. What fine steps would change (the *lag* of a model, its
coarse residual minus its fine one) is taken from one fine simulation, and again when a fit ends:
only fine residuals decide.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.evidence.constants import (
    COARSE_STEP_S,
    DRAWS,
    FINE_STEP_S,
    FIT_STEPS,
    FIT_STOP,
    LEFT_TIMES,
    NAME_NATS,
    NUGGET,
    SEEN_SHARE,
    SMALL_SHARE,
    STRETCH,
    SURE,
)
from pamctl.diagnose.evidence.likelihood import Likelihood, Loss, levels_of, to_haar
from pamctl.diagnose.evidence.paraboloid import FIRST_DAMPING, LEAST_DAMPING, Paraboloid
from pamctl.diagnose.evidence.pool import CHAIN, Unknown, Variant
from pamctl.diagnose.evidence.run_pieces import Runs

Array = NDArray[np.float64]

STEP = 2e-3
"""Of a number's scale: the step of a one-sided difference."""
NEAR = 0.5
"""Scales within which a tangent is that of the place."""
FAR_OFF = 3e-3
"""Of a channel's span (RMS): what leaves more is far from the truth. Half: dirty records take twice
the time. Twice: a creep beside a leak is not found."""
FAR_SHARE = 0.5
"""Of what a model leaves (RMS): what leaves less is by far better."""
MOST_TRIES = 8
"""Dampings that are tried, each ten times the last: the first steps may go round a box of longest
moves, where no tangent holds."""
KEPT_PROMISE = 0.3
"""A tangent is used again while a step gains this share of what it promised;"""
KEPT_BENT = 0.75
"""and a step is bent where it gains less than this share."""


@dataclass(eq=False)
class WeighedModel:
    """A model: what is free in it, where its fit stands, and what its residual costs."""

    names: tuple[str, ...]
    numbers: tuple[Unknown, ...]
    held: Mapping[str, float]
    x: Array
    picked: Mapping[str, Variant] = field(default_factory=dict)
    """The variant of each name."""
    d: Array = field(default_factory=lambda: np.zeros(0))
    """Residual as Haar coefficients; empty before the first simulation."""
    lag: Array | float = 0.0
    """Coarse residual minus fine residual."""
    tangent: Array | None = None
    """Change of d for a scale of each number, shape (numbers, *d.shape)."""
    tangent_at: Array = field(default_factory=lambda: np.zeros(0))
    """The numbers at which the tangent was simulated."""
    loss: Loss | None = None
    left_out: Array = field(default_factory=lambda: np.zeros(0))
    """Loss of each block as if it had been left out, those held out behind."""
    away: tuple[bytes, Array] | None = None
    """The numbers of the last simulation of the held-out records, and its residual."""

    @property
    def values(self) -> dict[str, float]:
        """All numbers by name."""
        return {
            **self.held,
            **{n.name: float(v) for n, v in zip(self.numbers, self.x, strict=True)},
        }

    @property
    def total(self) -> float:
        """Nats of all blocks, each left out."""
        return float(self.left_out.sum())

    @property
    def cost(self) -> Loss:
        """The loss under the last floor."""
        assert self.loss is not None
        return self.loss


class Weigher:
    """The records and their likelihood: it fits models, and weighs one against another."""

    def __init__(
        self,
        train: Runs,
        held_out: Runs | None,
        base: Mapping[str, float],
        noise: Mapping[str, float] | None = None,
    ) -> None:
        """Lay out the likelihoods; `base` holds the numbers of the plant that stay.

        `noise` states standard deviations of sensors, SI, by channel: no scale is below them.
        """
        self.train, self.held_out, self.base = train, held_out, base
        stated = ((noise or {}).get(channel, 0.0) for channel in train.channels)
        steps = zip(train.resolutions, stated, strict=True)
        least2 = np.array([max(q**2 / 12.0, s**2) for q, s in steps])
        level = levels_of(train.block)
        self.like = Likelihood(train.find_kept(level), least2)
        self.like_held = None
        if held_out is not None:
            self.like_held = Likelihood(held_out.find_kept(level), least2)
        self.floor2, self.further_noise2 = least2, train.find_start_error2()
        self.slow_noise2 = np.zeros(len(least2))
        """The part of it that was stated beyond what the columns show: it may be slow."""
        self.simulations, self.begun_s = 0, time.process_time()
        """How often all records were simulated, and since when."""
        self.pushes: dict[str, Array] = {}
        """Of each hypothesis, the square of what a unit dose adds to each channel's residual, and
        the model's own numbers do not."""
        self.secants: dict[str, tuple[Variant, Array, NDArray[np.float32]]] = {}
        """Of each hypothesis, the variant, directions and secants that promised most, beside the
        model at which it was asked last."""
        one = np.zeros_like(train.shown)
        self._zeros = {}
        for c, channel in enumerate(train.channels):
            one[:] = 0.0
            one[c] = -1.0
            self._zeros[f"{CHAIN}zero.{channel}"] = to_haar(one)

    def forget_responses(self) -> None:
        """Drop what hypotheses did to simulations that are not made like that any more."""
        self.pushes.clear()
        self.secants.clear()

    # --- residuals ---

    def find_residual(self, values: Mapping[str, float], step_s: float = COARSE_STEP_S) -> Array:
        """Return the Haar coefficients of what was measured minus what a plant shows."""
        return self.residual_of(self.train, values, step_s)

    def residual_of(
        self, runs: Runs, values: Mapping[str, float], step_s: float = COARSE_STEP_S
    ) -> Array:
        """Return the same of other records."""
        self.simulations += 1
        off = runs.shown - runs.simulate({**self.base, **values}, step_s)
        return to_haar(runs.fill_masked(off))

    def residual_at(self, m: WeighedModel, x: Array) -> Array:
        """Return a model's residual at other numbers, less the error of coarse steps."""
        moved = {n.name: float(v) for n, v in zip(m.numbers, x, strict=True)}
        d = self.find_residual({**m.held, **moved})
        d -= m.lag
        return d

    def refine(self, m: WeighedModel) -> None:
        """Simulate a model in fine steps; its residual is then the one that counts."""
        coarse, fine = (self.find_residual(m.values, s) for s in (COARSE_STEP_S, FINE_STEP_S))
        m.lag, m.d = coarse - fine, fine

    # --- fitting ---

    def find_column(self, m: WeighedModel, i: int) -> Array:
        """Return the change of the residual for a scale of one number."""
        number = m.numbers[i]
        if number.name in self._zeros:
            return self._zeros[number.name] * number.scale
        h = STEP * number.scale
        h = -h if m.x[i] + h > number.high else h
        x = m.x.copy()
        x[i] += h
        return (self.residual_at(m, x) - m.d) * (number.scale / h)

    def find_tangent(self, m: WeighedModel) -> Array:
        """Return the change of d for a scale of each number, simulated where it is missing."""
        if m.tangent is None:
            m.tangent = np.stack([self.find_column(m, i) for i in range(len(m.x))])
            m.tangent_at = m.x.copy()
        return m.tangent

    def fit(
        self, m: WeighedModel, steps: int = FIT_STEPS, *, is_rough: bool = False
    ) -> WeighedModel:
        """Fit under the present floor by Gauss and Newton; scales are found anew at each step.

        A step also corrects the tangent by what it moved (Broyden). A rough fit simulates no other.
        """
        scale = np.array([n.scale for n in m.numbers])
        if not m.d.size:
            self.refine(m)
        m.loss = self.like(m.d, self.floor2)
        damping = FIRST_DAMPING
        for step in range(steps):
            tangent = self.find_tangent(m)
            fresh = is_rough or bool((np.abs(m.x - m.tangent_at) < NEAR * scale).all())
            slopes = self.like.find_slopes(m.d, m.cost, self.floor2)
            here = Paraboloid(m.numbers, m.x, m.d, tangent, slopes)
            if fresh and here.promise(here.step(LEAST_DAMPING)) < FIT_STOP:
                break
            cost, better = float(m.cost.by_block.sum()), None
            for _ in range(MOST_TRIES if fresh else 1):
                better = self._go_down(m, here, damping)
                if better is not None:
                    break
                damping *= 10.0
                if here.promise(here.step(damping)) < FIT_STOP:
                    break
            if better is None:
                if fresh:
                    break
                m.tangent = None
                continue
            go, d, m.loss = better
            here.correct(go, (d - m.d).ravel())
            m.x, m.d = here.move(go), d
            gained = cost - float(m.loss.by_block.sum())
            stays = fresh if gained < FIT_STOP else gained > KEPT_PROMISE * here.promise(go)
            damping = LEAST_DAMPING if gained < FIT_STOP else max(damping / 10.0, LEAST_DAMPING)
            if not stays and not is_rough and step < steps - 1:
                m.tangent = None
        self.find_tangent(m)
        return m

    def _go_down(
        self, m: WeighedModel, here: Paraboloid, damping: float
    ) -> tuple[Array, Array, Loss] | None:
        """Return a step that costs less, bent if it gains little; None where it costs more.

        Its residual and loss are those behind it.
        """
        cost, found = float(m.cost.by_block.sum()), None
        go = here.step(damping)
        least = cost - KEPT_BENT * here.promise(go)
        for _ in range(2):
            d = self.residual_at(m, here.move(go))
            loss = self.like(d, self.floor2, m.cost.scales2)
            now = float(loss.by_block.sum())
            if now < cost:
                cost, found = now, (go, d, loss)
            if now < least:
                break
            go = here.bend(go, (d - m.d).ravel(), damping)
        return found

    def polish(self, m: WeighedModel, steps: int = FIT_STEPS) -> WeighedModel:
        """Fit to the end by fine residuals: until the steps' error moves nothing."""
        for _ in range(3):
            self.fit(m, steps)
            before = float(m.cost.by_block.sum())
            self.refine(m)
            m.loss = self.like(m.d, self.floor2)
            if abs(float(m.loss.by_block.sum()) - before) < FIT_STOP:
                break
        return self.leave_out(m)

    def settle(self, m: WeighedModel, steps: int = FIT_STEPS) -> WeighedModel:
        """Fit while the floor follows down: far misfits first count whole, later by their parts."""
        if not m.d.size:
            self.refine(m)
        for _ in range(4):
            before = self.like.mean_squares(m.d)
            self.set_floor(m)
            self.fit(m, steps)
            if (self.like.mean_squares(m.d) > 0.8 * before).all():
                break
        self.refine(m)
        self.set_floor(m)
        return self.polish(m, 3)

    # --- weighing ---

    def set_floor(self, *models: WeighedModel) -> None:
        """Take the resolution of the model that is to be beaten: of several the poorest."""
        left2 = np.max([self.like.mean_squares(m.d) for m in models], axis=0)
        self.floor2 = np.maximum(self.like.least2, NUGGET**2 * left2)

    def leave_out(self, m: WeighedModel) -> WeighedModel:
        """Weigh a model with each block left out, to first order; then the held-out blocks."""
        m.loss = self.like(m.d, self.floor2)
        optimism = find_optimism(self.find_tangent(m), m.loss.weights, m.d)
        m.left_out = m.loss.by_block + optimism
        if self.held_out is not None and self.like_held is not None:
            key = m.x.tobytes()
            if m.away is None or m.away[0] != key:
                m.away = key, self.residual_of(self.held_out, m.values, FINE_STEP_S)
            held = self.like_held(m.away[1], self.floor2, scales2=m.loss.scales2)
            m.left_out = np.concatenate([m.left_out, held.by_block])
        return m

    def meet(self, poorer: WeighedModel, better: WeighedModel) -> None:
        """Weigh both by what both can resolve, in each channel: only then do their nats compare."""
        self.set_floor(poorer, better)
        self.leave_out(poorer)
        self.leave_out(better)

    def weigh_alone(self, m: WeighedModel) -> float:
        """Return a model's nats by what it resolves itself: an order of models that are far apart.

        What the poorer one resolves would hide how much better the other is in a channel. Between
        neighbours these nats say too much: a lower floor alone changes all scales that stand on it.
        """
        floor2 = self.floor2
        self.set_floor(m)
        total = self.leave_out(m).total
        self.floor2 = floor2
        return total

    def find_imprint(self, a: WeighedModel, b: WeighedModel) -> Array:
        """Return the robust RMS that b takes off a in each channel, over the sensor's noise.

        Only the time scales count at which it takes something off: at others its own numbers may
        leave more, as they no longer stand in for what is missing there.
        """
        off2 = robust2_of(self.like, a.d) - robust2_of(self.like, b.d)
        return np.asarray(np.sqrt(np.maximum(off2, 0.0).sum(axis=1) / self.find_noise2(b)))

    def find_robust2(self, m: WeighedModel) -> Array:
        """Return the robust mean square of each channel's residual, SI."""
        return np.asarray(robust2_of(self.like, m.d).sum(axis=1))

    def find_noise2(self, m: WeighedModel) -> Array:
        """Return the squared noise of each channel: its finest level, never below its step.

        `further_noise2` is what else a perfect model leaves: by the first speed of each window, and
        by the noise of measured columns that drive it.
        """
        fine = m.d[..., : self.like.block // 2] ** 2
        kept = self.like.keep[..., : self.like.block // 2]
        middle = np.array([np.median(f[k]) for f, k in zip(fine, kept, strict=True)])
        return np.maximum(middle / 0.455, self.like.least2) + self.further_noise2

    def is_much_left(self, m: WeighedModel) -> bool:
        """Tell whether a model leaves clearly more than the noise of some channel."""
        left2 = self.find_robust2(m) / self.find_noise2(m)
        return bool(left2.max() >= LEFT_TIMES**2)

    def is_far_off(self, m: WeighedModel) -> bool:
        """Tell whether a model is so far from what was measured that no tangent tells the way."""
        span = np.ptp(self.train.shown.reshape(len(self.train.shown), -1), axis=1)
        return bool((self.find_robust2(m) > (FAR_OFF * span) ** 2).any())

    def find_seen(self, a: WeighedModel, b: WeighedModel) -> Array:
        """Return the share of each channel's robust mean square that b takes off a."""
        left2 = [(self.like.counts * m.cost.scales2).sum(axis=1) for m in (a, b)]
        return np.asarray(1.0 - left2[1] / left2[0])

    def may_be_seen(self, a: WeighedModel, b: WeighedModel) -> bool:
        """Tell whether a rough fit of b takes off a half of what a reader sees."""
        seen = self.find_seen(a, b).max() > 0.5 * SEEN_SHARE
        return bool(seen or self.find_imprint(a, b).max() > 0.5)

    def is_small(self, m: WeighedModel) -> bool:
        """Tell whether a model's last name is smaller than what is of interest."""
        sizes = m.picked[m.names[-1]].sizes
        away = ((abs(m.values[u.name] - (u.neutral or 0.0)), u.smallest) for u in sizes)
        return all(size < SMALL_SHARE * smallest for size, smallest in away)

    def is_by_far_better(self, a: WeighedModel, b: WeighedModel) -> bool:
        """Tell whether b leaves half of what a leaves, beyond what is much, of fitted and held-out.

        It leaves of no channel more.
        """
        much2 = LEFT_TIMES**2 * self.find_noise2(b)[:, None]
        left2 = np.stack([np.maximum(self._list_robust2(m), much2) for m in (a, b)])
        shares = left2[1] / left2[0]
        return bool((shares <= 1.0).all() and (shares.min(axis=0) < FAR_SHARE**2).all())

    def _list_robust2(self, m: WeighedModel) -> Array:
        """Return the robust mean squares of the fitted records, and of those that are held out."""
        parts = [(self.like, m.d)]
        if self.like_held is not None and m.away is not None:
            parts.append((self.like_held, m.away[1]))
        return np.stack([robust2_of(like, d).sum(axis=1) for like, d in parts], axis=1)

    def counts(self, a: WeighedModel, b: WeighedModel) -> bool:
        """Tell whether b's last name is worth saying against a: sure, seen, and sized.

        It gains on the records that are held out, too; far from the truth it does not surely lose
        there. What leaves a half of what was much, and of no channel more, counts anyway: the
        poorer model resolves little of it.
        """
        if self.is_small(b):
            return False
        if self.is_by_far_better(a, b):
            return True
        gain = a.left_out - b.left_out
        low, middle, _ = bound_gain(gain)
        if low <= 0.0 or middle <= NAME_NATS:
            return False
        held_out = gain[self.like.n_blocks :]
        if held_out.sum() < 0.0 and not (self.is_far_off(b) and bound_gain(held_out)[2] > 0.0):
            return False
        seen = self.find_seen(a, b).max() > SEEN_SHARE
        return bool(seen or self.find_imprint(a, b).max() > 1.0)


def robust2_of(like: Likelihood, d: Array) -> Array:
    """Return the part of each level in each channel's robust mean square, SI."""
    scales2, counts = like.find_scales2(d, like.least2), like.counts
    return np.asarray(counts * scales2 / counts.sum(axis=1, keepdims=True))


def find_optimism(tangent: Array, weights: Array, d: Array) -> Array:
    """Return what each block gained by being fitted: g_b' H^-1 g_b, without a refit."""
    count, (_, n_blocks, _) = len(tangent), d.shape
    flat = tangent.reshape(count, -1)
    weighed = flat * weights.ravel()
    hessian = weighed @ flat.T
    hessian += 1e-9 * np.diag(np.diag(hessian)) + 1e-12 * max(hessian.max(), 1e-30) * np.eye(count)
    by_block = (weighed * d.ravel()).reshape(count, len(d), n_blocks, -1).sum(axis=(1, 3))
    return np.asarray(np.einsum("ib,ij,jb->b", by_block, np.linalg.inv(hessian), by_block))


def bound_gain(gain: Array, quantiles: Sequence[float] | Array = (SURE, 0.5, 1.0 - SURE)) -> Array:
    """Return quantiles of a total gain: circular bootstrap over stretches of blocks."""
    n, rng = len(gain), np.random.default_rng(0)
    pieces = max(1, -(-n // STRETCH))
    begins = rng.integers(0, n, (DRAWS, pieces))
    sums = np.concatenate([[0.0], np.cumsum(np.concatenate([gain, gain[:STRETCH]]))])
    totals = (sums[begins + min(STRETCH, n)] - sums[begins]).sum(axis=1)
    return np.asarray(np.quantile(totals * n / (pieces * min(STRETCH, n)), quantiles))
