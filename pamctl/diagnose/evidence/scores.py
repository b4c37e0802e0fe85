"""The score of a hypothesis without a fit: what secants at fitting doses would gain.

A hypothesis is simulated at a dose that grows or shrinks until it moves the residual of some
channel by about that residual itself, less what the model's own numbers do as well, while these
move by a scale at most: their tangent holds so far. Beside that tangent a weighted least-squares
fit of dose and numbers predicts the residual, and the likelihood what that is worth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.evidence.constants import KEPT, MOST_DOSE, SCORE_STEP_S
from pamctl.diagnose.evidence.fit import WeighedModel, Weigher
from pamctl.diagnose.evidence.likelihood import from_haar
from pamctl.diagnose.evidence.pool import Hypothesis, Unknown, Variant

Array = NDArray[np.float64]

HATS = np.array([[1, 1, 1, 1, 1], [-1, -0.5, 0, 0.5, 1], [1, 0, -1, 0, 1]], dtype=float)
"""What a curve is scored by: level, slope and hump; all five knots are fitted."""
MOST_SHARE = 3.0
"""A least-squares dose may be so many times the simulated one."""
MOST_HAT = 10.0
HOPE_NATS = 4.0
"""Of what promises less, no reader sees anything."""
ALIKE = 1e-4
"""Of a secant's square: what is smaller beside the model's tangent is rounding."""
NEARLY_OWN = 0.1
"""Share of a secant that the model's own numbers leave, below which no tangent tells the rest: then
these are simulated moved beside the dose."""
LIKELY_MOVE = 10.0
"""Scales that a number may move beside a new hypothesis: what no sample shows stays."""
STUCK = 1e-3
"""Scales from its range at which a number counts as held by it."""
HIGHEST_HZ = 60.0
"""Of a ripple: pumps and mains are slower."""
MOST_KEPT = 600_000
"""Numbers in secants that are kept: 2.4 MB of each hypothesis, for five minutes of records."""
LONGEST_ANSWER_S = 2.0
"""Of a position to an impulse of force, in the search for waves."""
LEAST_N_PER_M = 1e-6
"""Of a spring: without one the position remembers a force for good."""
LINE = ((1.0, 1.0), (1.0, 0.3), (1.0, 0.0), (0.2, 0.2), (0.2, 0.0), (0.03, 0.0))
"""Shares of a prediction, of the new sizes and of the model's numbers, at which a fit may start."""


class EvidenceScore(NamedTuple):
    """What a hypothesis promises, and where its fit should start."""

    gain: float
    name: str
    variant: Variant
    sizes: Array
    """Of each size, the prediction."""
    move: Array
    """Of the model's own numbers, in scales."""
    shows: bool = False
    """Whether it takes off half of what a reader sees: a fit hardly takes off more."""


def score_all(
    weigher: Weigher, m: WeighedModel, hypotheses: Sequence[Hypothesis]
) -> list[EvidenceScore]:
    """Return the scores of hypotheses beside a model, the best first.

    Of a large pool a hypothesis is not simulated again if its secants beside an earlier model leave
    it far behind.
    """
    beside, is_large = _Beside(weigher, m), len(hypotheses) > 2 * KEPT
    guesses = {h.name: beside.guess(h) for h in hypotheses} if is_large else {}
    known = sorted((s for s in guesses.values() if s is not None), key=lambda s: -s.gain)
    far = {s.name for s in known[KEPT:]}
    found = [guesses[h.name] if h.name in far else beside.score(h) for h in hypotheses]
    return sorted((s for s in found if s is not None), key=lambda s: -s.gain)


class _Own(NamedTuple):
    """Numbers of a model that may move beside a hypothesis, and what they do, weighed."""

    free: NDArray[np.intp]
    tangent: Array
    weighed: Array
    inverse: Array
    slope: Array


class _Beside:
    """A model's residual and tangent, weighed: what all scores beside it share."""

    def __init__(self, weigher: Weigher, m: WeighedModel) -> None:
        self.weigher, self.m, cost = weigher, m, m.cost
        low, high, scale = (
            np.array([getattr(n, k) for n in m.numbers]) for k in ("low", "high", "scale")
        )
        self.room = (low - m.x) / scale, (high - m.x) / scale
        self.root = np.sqrt(weigher.like.find_slopes(m.d, cost, weigher.floor2)).ravel()
        self.off = m.d.ravel() * self.root
        is_inside = (self.room[0] < -STUCK) & (self.room[1] > STUCK)
        self.own = self._weigh_own(is_inside)
        self.ways = [self.own]
        """What may move: a number at its range stays, or a hypothesis draws it back inside."""
        if not is_inside.all():
            self.ways.append(self._weigh_own(np.ones_like(is_inside)))
        self.size2 = np.maximum((m.d**2 * self.weigher.like.keep).sum(axis=(1, 2)), 1e-300)
        self.here = self.show(m.values)

    def _weigh_own(self, is_free: NDArray[np.bool_]) -> _Own:
        assert self.m.tangent is not None
        tangent = self.m.tangent.reshape(len(self.m.x), -1)[is_free]
        weighed = tangent * self.root
        hessian = weighed @ weighed.T + LIKELY_MOVE**-2 * np.eye(len(weighed))
        inverse = np.asarray(np.linalg.inv(hessian), dtype=float)
        return _Own(np.flatnonzero(is_free), tangent, weighed, inverse, weighed @ self.off)

    def show(self, values: Mapping[str, float]) -> Array:
        """Return the residual of other numbers, in steps that are long enough to compare."""
        return self.weigher.find_residual(values, SCORE_STEP_S)

    def score(self, hypothesis: Hypothesis) -> EvidenceScore | None:
        """Return the best of the variants and doses; None where none does anything."""
        variants = self._scan(hypothesis) if hypothesis.scan else hypothesis.variants
        best: tuple[EvidenceScore, WeighedModel] | None = None
        for variant in variants:
            for sizes, secants in self._push(hypothesis.name, variant):
                found = self._predict(hypothesis.name, variant, sizes, secants)
                if found is not None and (best is None or found[0].gain > best[0].gain):
                    best = found
                    if not hypothesis.scan and secants.size < MOST_KEPT:
                        kept = secants.astype(np.float32)
                        self.weigher.secants[hypothesis.name] = variant, sizes, kept
        return self._look_at(best)

    def guess(self, hypothesis: Hypothesis) -> EvidenceScore | None:
        """Return the score by the secants beside a model before; None where there are none."""
        known = self.weigher.secants.get(hypothesis.name)
        if known is None:
            return None
        variant, directions, secants = known
        predicted = self._predict(hypothesis.name, variant, directions, secants.astype(float))
        return self._look_at(predicted)

    def _look_at(self, found: tuple[EvidenceScore, WeighedModel] | None) -> EvidenceScore | None:
        """Return a score that says whether a reader sees what it promises."""
        if found is None:
            return None
        score, there = found
        hopes = score.gain > HOPE_NATS
        return score._replace(shows=hopes and self.weigher.may_be_seen(self.m, there))

    def _push(self, name: str, variant: Variant) -> Iterator[tuple[Array, Array]]:
        """Yield directions of the sizes, and the secants along them, at doses that fit."""
        neutral = np.array([u.neutral or 0.0 for u in variant.sizes])
        usual = np.array([u.value for u in variant.sizes]) - neutral
        held = {**self.m.values, **variant.held, **{u.name: u.value for u in variant.shapes}}
        directions = HATS if variant.is_curve else np.diag(usual)
        known = self.weigher.pushes.get(name)
        dose = 1.0
        if known is not None and known.any():
            fits = float((known / self.size2).max()) ** -0.5
            dose = min(max(fits, 1.0 / MOST_DOSE), MOST_DOSE)
        room = min(
            ((u.high if w > 0.0 else u.low) - n) / w
            for u, n, w in zip(variant.sizes, neutral, usual, strict=True)
        )
        dose = min(dose, 0.9 * room)
        if any(not u.low <= (u.neutral or 0.0) <= u.high for u in variant.sizes):
            dose = 1.0  # a column is turned round or not: there is nothing between
        for again in range(3):
            secants = []
            for way in directions * dose:
                sizes = {
                    u.name: float(v) for u, v in zip(variant.sizes, neutral + way, strict=True)
                }
                d = self.show({**held, **sizes})
                secants.append((d - self.here).ravel())
            own, rest = self._find_rest(np.stack(secants), {**held, **sizes})
            most = float(np.abs(own).max(initial=0.0))
            moved2 = (rest.reshape(len(own), *self.m.d.shape) ** 2).sum(axis=(2, 3))
            self.weigher.pushes[name] = moved2.max(axis=0) / dose**2
            big = float((moved2 / self.size2).max())
            yield directions * dose, rest + own @ self.own.tangent
            room = min(room, dose / max(most, 1e-30))
            if again == 2 or big == 0.0 or 0.1 <= big <= 4.0:
                return
            if big > 4.0:
                dose *= max(0.02, big**-0.5)
                continue
            grown = min(dose * min(MOST_DOSE, big**-0.5), 0.9 * room)
            if grown < 1.5 * dose:
                return
            dose = grown

    def _find_rest(self, secants: Array, dosed: Mapping[str, float]) -> tuple[Array, Array]:
        """Return the own numbers' part of secants, in scales, and what they leave of them.

        `dosed` are the values of which a single secant was simulated.
        """
        own = (secants * self.root) @ self.own.weighed.T @ self.own.inverse
        rest = secants - own @ self.own.tangent
        is_own = (rest**2).sum() < NEARLY_OWN**2 * (secants**2).sum() and np.abs(own).max() < 1.0
        if len(own) > 1 or not is_own:
            return own, rest
        move = np.zeros(len(self.m.x))
        move[self.own.free] = -own[0]
        move = np.clip(move, *self.room)
        moved = {
            n.name: float(v + k * n.scale)
            for n, v, k in zip(self.m.numbers, self.m.x, move, strict=True)
        }
        both = (self.show({**dosed, **moved}) - self.here).ravel()
        return -move[None, self.own.free], both[None]

    def _predict(
        self, name: str, variant: Variant, directions: Array, secants: Array
    ) -> tuple[EvidenceScore, WeighedModel] | None:
        """Return the best dose, and the model that is expected there."""
        weighed, best = secants * self.root, None
        for own in self.ways:
            for share, moved in _solve(own, variant, directions, weighed, self.off):
                found = self._foresee(secants, share, own, moved)
                if best is None or found[0] > best[0][0]:
                    best = found, share
                if found[0] >= 0.0:
                    break  # else the tangent of the model's numbers leads off: they stay
        if best is None:
            return None
        (gain, move, there), share = best
        neutral = np.array([u.neutral or 0.0 for u in variant.sizes])
        return EvidenceScore(gain, name, variant, neutral + share @ directions, move), there

    def _foresee(
        self, secants: Array, share: Array, own: _Own, moved: Array
    ) -> tuple[float, Array, WeighedModel]:
        """Return what a dose and a move of free numbers gain, the whole move, the model there.

        Of that model only what it leaves is known.
        """
        move = np.zeros(len(self.m.x))
        move[own.free] = moved
        move = np.clip(move, *self.room)
        left = self.m.d.ravel() + share @ secants + move[own.free] @ own.tangent
        there = WeighedModel((), (), {}, self.m.x, d=left.reshape(self.m.d.shape))
        there.loss = self.weigher.like(there.d, self.weigher.floor2, self.m.cost.scales2)
        gain = float(self.m.cost.by_block.sum() - there.cost.by_block.sum())
        return gain, move, there

    # --- waves ---

    def _scan(self, hypothesis: Hypothesis) -> Iterator[Variant]:
        """Yield the variants at the two best periods, by directions that cost no simulation.

        The weighed residual, back in time, is correlated with what a wave of each period would do
        to the readings: for a force an answer of the mass, for a supply the change by a constant
        pressure. A wave in time also has a weight: that of the levels of its frequency.
        """
        runs, m = self.weigher.train, self.m
        off = self.off - self.own.inverse @ self.own.slope @ self.own.weighed
        pull = from_haar((off * self.root).reshape(self.m.d.shape)).reshape(len(runs.channels), -1)
        if hypothesis.scan == "position":
            if "position_m" not in runs.channels:
                return
            row = runs.channels.index("position_m")
            pull = pull[row][None]
            if hypothesis.place != "encoder":  # a force moves the mass first
                response = self._respond_to_force()
                pieces = np.split(pull[0], runs.find_fresh_starts())
                pull = np.concatenate([_lag_backwards(p, response) for p in pieces])[None]
            over = runs.shown[row].ravel()
        else:
            tank = "tank_pressure_pa"
            more = {**m.values, tank: m.values.get(tank, self.weigher.base[tank]) + 1e3}
            way = from_haar(self.show(more) - self.here).reshape(pull.shape)
            pull, over = (pull * way).sum(axis=0)[None], runs.when_s.ravel()
        span = float(np.ptp(over))
        if span <= 0.0:
            return
        bins, highest = 4096, 100.0 / span
        if hypothesis.scan == "time":
            highest = min(HIGHEST_HZ, 0.2 / runs.period_s)
            bins = max(bins, 1 << round(np.log2(4.0 * highest * span) + 0.5))
        place = ((over - over.min()) / span * (bins - 1)).astype(int)
        spectrum = np.abs(np.fft.rfft(np.bincount(place, pull.sum(axis=0), bins), 4 * bins)) ** 2
        rates = np.arange(len(spectrum)) / (4.0 * span) * (bins - 1) / bins
        if hypothesis.scan == "time":
            spectrum /= self._weigh_rates(rates, (way**2).sum(axis=1))
        # Of a wave that is not seen whole nobody can tell that it comes again.
        spectrum[(rates < 1.0 / span) | (rates > highest)] = 0.0
        variant = hypothesis.variants[0]
        for _ in range(2):
            best = int(spectrum.argmax())
            value = float(1.0 / rates[best] if hypothesis.scan == "position" else rates[best])
            width = value / max(rates[best] * span, 1.0)
            low, high = max(value - width, 0.3 * value), value + width
            if hypothesis.scan == "position":
                high = min(high, span)
            else:
                low = max(low, 1.0 / span)
            shape = replace(variant.shapes[0], value=value, low=low, high=high, scale=0.1 * width)
            yield variant._replace(shapes=(shape,))
            spectrum[max(best - 5, 0) : best + 6] = 0.0

    def _weigh_rates(self, rates: Array, size2: Array) -> Array:
        """Return the weighed square of waves in time, Hz, whose squares are these by channel."""
        like, weights = self.weigher.like, self.m.cost.weights
        levels = np.arange(like.n_levels)
        at = np.log2(1.0 / (self.weigher.train.period_s * np.maximum(rates, 1e-9))) - 1.5
        total = np.zeros(len(rates))
        for rows, counts, square in zip(weights, like.counts, size2, strict=True):
            usual = np.bincount(like.level, rows.sum(axis=0), like.n_levels)
            total += square * np.interp(at, levels, usual / np.maximum(counts, 1.0))
        return np.maximum(total, 1e-300)

    def _respond_to_force(self) -> Array:
        """Return how the position answers an impulse of force, until that is forgotten."""
        values, period_s = {**self.weigher.base, **self.m.values}, self.weigher.train.period_s
        names = ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m")
        mass, damping, stiffness = (values[name] for name in names)
        fast, slow = sorted(np.roots([mass, damping, stiffness + LEAST_N_PER_M]), key=np.real)
        lasts_s = min(5.0 / max(-slow.real, 1e-9), LONGEST_ANSWER_S)
        t_s = period_s * np.arange(round(lasts_s / period_s))
        answer = (np.exp(slow * t_s) - np.exp(fast * t_s)) / (slow - fast + 1e-9)
        return np.asarray(answer.real)


def _solve(
    own: _Own, variant: Variant, directions: Array, weighed: Array, off: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield least-squares doses and moves of a model's own numbers; the second moves none."""
    inside, alone = weighed @ own.weighed.T, weighed @ weighed.T
    normal = alone - inside @ own.inverse @ inside.T
    if not np.isfinite(normal).all() or np.trace(normal) < 1e-6:
        return
    # What the model's own numbers do as well is not asked for by a large dose.
    ridge = np.diag(ALIKE * np.diag(alone) + 1e-6 * np.trace(normal))
    fitted = -np.linalg.solve(normal + ridge, weighed @ off - inside @ own.inverse @ own.slope)
    share = _bound_share(variant, directions, fitted)
    yield share, -own.inverse @ (own.slope + inside.T @ share)
    share = _bound_share(variant, directions, -np.linalg.solve(alone + ridge, weighed @ off))
    yield share, np.zeros(len(own.free))


def _bound_share(variant: Variant, directions: Array, share: NDArray[Any]) -> Array:
    """Return a share of each direction of a variant's sizes inside its bounds."""
    if variant.is_curve:
        return np.asarray(np.clip(share, -MOST_HAT, MOST_HAT))
    one_sided = [u.low >= (u.neutral or 0.0) or u.high <= (u.neutral or 0.0) for u in variant.sizes]
    share = np.clip(share, np.where(one_sided, 0.0, -MOST_SHARE), MOST_SHARE)
    if len(share) == 1:  # not beyond its range, which need not begin at its neutral value
        u, usual = variant.sizes[0], float(directions[0, 0])
        ends = [(end - (u.neutral or 0.0)) / usual for end in (u.low, u.high)]
        share = np.clip(share, min(ends), max(ends))
    return np.asarray(share)


def _lag_backwards(row: Array, response: Array) -> Array:
    """Return a row behind an impulse response that runs from its end to its beginning."""
    size = len(row) + len(response)
    product = np.fft.rfft(row[::-1], size) * np.fft.rfft(response, size)
    return np.asarray(np.fft.irfft(product, size)[: len(row)][::-1])


def extend_model(weigher: Weigher, m: WeighedModel, score: EvidenceScore) -> WeighedModel:
    """Return the model with a hypothesis, at the best of some points along the prediction."""
    variant = score.variant
    sizes = [_put_inside(u, v) for u, v in zip(variant.sizes, score.sizes, strict=True)]
    shapes = [u.value for u in variant.shapes]
    numbers = (*m.numbers, *variant.free)
    free = {u.name for u in variant.free}
    held = {**m.held, **{k: v for k, v in variant.held.items() if k not in free}}
    begin = np.concatenate([m.x, [u.neutral or 0.0 for u in variant.sizes], shapes])
    moved = m.x + np.clip(score.move, -LIKELY_MOVE, LIKELY_MOVE) * [n.scale for n in m.numbers]
    end = np.concatenate([moved, sizes, shapes])
    low, high = (np.array([getattr(n, k) for n in numbers]) for k in ("low", "high"))
    e = WeighedModel(
        (*m.names, score.name), numbers, held, begin, {**m.picked, score.name: variant}, lag=m.lag
    )
    tries = []
    for new, old in LINE:
        share = np.concatenate([np.full(len(m.x), old), np.full(len(variant.free), new)])
        x = np.clip(begin + share * (end - begin), low, high)
        d = weigher.residual_at(e, x)
        tries.append((float(weigher.like(d, weigher.floor2).by_block.sum()), x, d))
    _, e.x, e.d = min(tries, key=lambda t: t[0])
    assert m.tangent is not None
    columns = [weigher.find_column(e, i) for i in range(len(m.x), len(e.x))]
    e.tangent, e.tangent_at = np.concatenate([m.tangent, np.stack(columns)]), e.x.copy()
    return e


def _put_inside(unknown: Unknown, value: float) -> float:
    """Return a value inside the range, and off the neutral end of it."""
    inside = min(max(value, unknown.low), unknown.high)
    if inside == unknown.neutral:
        inside += 1e-3 * unknown.scale * (1.0 if unknown.low >= unknown.neutral else -1.0)
    return inside


def drop_name(m: WeighedModel, name: str) -> WeighedModel:
    """Return the model without one of its names, unfitted; it starts where the model stands."""
    variant = m.picked[name]
    gone = {u.name for u in variant.free} | {*variant.held}
    keep = [i for i, number in enumerate(m.numbers) if number.name not in gone]
    return WeighedModel(
        tuple(n for n in m.names if n != name),
        tuple(m.numbers[i] for i in keep),
        {k: v for k, v in m.held.items() if k not in gone},
        m.x[keep],
        {k: v for k, v in m.picked.items() if k != name},
    )
