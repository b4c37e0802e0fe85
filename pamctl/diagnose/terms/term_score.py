"""Ask all questions of a residual, in output-error form, and rank them.

A dose of each term is simulated by the plant itself. What recalibration can imitate is projected
out of doses and residual. A term's score is the share of the residual's square that it predicts
of stretches that did not fit it: half of the stretches fit its amounts, the other half judges, and
the other way round. So a curve of five numbers has no advantage over a constant.

So many questions find something in any residual. The score that counts is what the best of all
questions reaches on residuals whose stretches have random signs: then nothing is left to be found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.fitting.block_fit import Fit, find_secants, project_out, rms
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.terms.doses import Doses
from pamctl.diagnose.terms.grammar import Question

STRETCH_S = 0.25
"""Stretches whose signs are drawn: residuals this far apart count as independent."""
FEWEST_STRETCHES = 24
TURN = 4
"""Stretches that fit in turn with as many that judge: whole seconds, not neighbours."""
SHUFFLES = 40
"""Residuals with random signs, from which the search's own score is known."""
CHANCE = 0.95
"""Quantile of the best scores of those residuals: one search in twenty finds more in nothing."""
RIDGE = 1e-4
"""Relative to the square of the columns: doses that recalibration imitates get small amounts."""
ROBUST = 10.0
"""Residuals above this multiple of the usual one count less."""
DOSE = 0.5
"""RMS of a dose's result, as a share of the residual's."""
MOST_RELINEARISED = 12
SAME = 0.98
"""Terms whose fitted results correlate by more than this cannot be told apart."""


@dataclass(frozen=True)
class TermScore:
    """What one question explains of a residual."""

    question: Question
    explained: float
    """Share of the square of stretches that did not fit it, after recalibration."""
    amounts: tuple[float, ...]
    """The term's size in each of its shapes."""
    result: Array
    """What the term adds to the output, without what recalibration imitates, shape (n,)."""


@dataclass(frozen=True)
class TermRanking:
    """All questions that were asked of one block, the best first."""

    block: str
    scores: tuple[TermScore, ...]
    asked: int
    by_chance: float
    """The score that the best of so many questions reaches where there is nothing to find."""

    def group(self, most: int) -> list[list[TermScore]]:
        """Return the scores above chance in groups of results that look alike, the best first."""
        groups: list[list[TermScore]] = []
        for score in self.scores:
            if score.explained <= self.by_chance:
                break
            for others in groups:
                if _correlate(score.result, others[0].result) > SAME:
                    others.append(score)
                    break
            else:
                if len(groups) == most:
                    break
                groups.append([score])
        return groups


def _correlate(one: Array, other: Array) -> float:
    size = float(np.sqrt((one @ one) * (other @ other)))
    return abs(float(one @ other)) / size if size > 0.0 else 0.0


class _Residual:
    """A block's residual as the questions see it."""

    def __init__(self, fitted: Fit) -> None:
        self.fitted = fitted
        raw = fitted.residual
        knee = ROBUST * max(float(np.median(np.abs(raw))) / 0.6745, 1e-9)
        self.weights: Array = np.minimum(1.0, np.sqrt(knee / np.maximum(np.abs(raw), 1e-12)))
        bound = fitted.at_bound
        movable = [i for i, free in enumerate(fitted.free) if free.name not in bound]
        weighed = fitted.jacobian[:, movable] * self.weights[:, None]
        self.basis: Array = np.linalg.qr(weighed)[0] if movable else np.zeros((len(raw), 0))
        self.left: Array = self.clean(raw)
        period_s = float(np.median(fitted.drives[0].step_s))
        self.length = max(min(round(STRETCH_S / period_s), len(raw) // FEWEST_STRETCHES), 1)
        self.stretches = -(-len(raw) // self.length)

    def clean(self, columns: Array) -> Array:
        """Weigh rows, and remove what recalibration imitates."""
        weights = self.weights if columns.ndim == 1 else self.weights[:, None]
        return project_out(self.basis, columns * weights)

    def sum_products(self, columns: Array) -> Array:
        """Return the products of the columns by one another, shape (stretches, p, p)."""
        count = columns.shape[1]
        stretches = np.zeros((self.stretches, self.length, count))
        stretches.reshape(-1, count)[: len(columns)] = columns
        products: Array = stretches.transpose(0, 2, 1) @ stretches
        return products


@dataclass(frozen=True)
class _Sums:
    """The normal equations of one question, by stretch."""

    squares: Array
    """Of columns by columns, shape (stretches, p, p)."""
    products: Array
    """Of columns by the residual, shape (stretches, p)."""

    def predict(self, signs: Array) -> Array:
        """Return by how much the amounts of each half reduce the square of the other half.

        `signs` are those of the residual's stretches, shape (m, stretches); the result (m,).
        """
        gained = np.zeros(len(signs))
        halves = np.arange(len(self.products)) // TURN % 2 == 0
        for fit in (halves, ~halves):
            amounts = (signs[:, fit] @ self.products[fit]) @ self._invert(fit)
            product = signs[:, ~fit] @ self.products[~fit]
            squared = np.einsum("mi,ij,mj->m", amounts, self.squares[~fit].sum(axis=0), amounts)
            gained += 2.0 * np.sum(amounts * product, axis=1) - squared
        return gained

    def fit_all(self) -> Array:
        """Return the amounts that fit all stretches best."""
        every = np.ones(len(self.products), dtype=np.bool_)
        amounts: Array = self._invert(every) @ self.products.sum(axis=0)
        return amounts

    def _invert(self, rows: NDArray[np.bool_]) -> Array:
        squares = self.squares[rows].sum(axis=0)
        scale = np.sqrt(np.maximum(np.diag(squares), 1e-300))
        scaled = squares / np.outer(scale, scale) + RIDGE * np.eye(len(scale))
        inverse: Array = np.linalg.inv(scaled) / np.outer(scale, scale)
        return inverse


def rank_terms(fitted: Fit, block: str, questions: Sequence[Question]) -> TermRanking:
    """Score all questions on a block's fit, the best first; see the module's text."""
    residual, doses = _Residual(fitted), Doses(fitted)
    sizes = _choose_sizes(residual, questions)
    total = float(residual.left @ residual.left)
    random = np.random.default_rng(17)
    signs = random.choice([-1.0, 1.0], (SHUFFLES, residual.stretches))
    by_chance = np.zeros(SHUFFLES)
    scores: list[TermScore] = []
    for question in questions:
        size = sizes[question.location.name] / question.typical_shape()
        columns = doses.answer(question, 1.0 if question.is_following else size)
        score, sums = _score_columns(residual, question, columns)
        scores.append(score)
        by_chance = np.maximum(by_chance, sums.predict(signs) / total)
    scores.sort(key=lambda s: -s.explained)
    first = [_score_again(residual, doses, s) for s in scores[:MOST_RELINEARISED]]
    ranked = sorted((*first, *scores[MOST_RELINEARISED:]), key=lambda s: -s.explained)
    chance = float(np.quantile(by_chance, CHANCE))
    return TermRanking(block, tuple(ranked), len(questions), chance)


def _choose_sizes(residual: _Residual, questions: Sequence[Question]) -> dict[str, float]:
    """Return for each location the size of a constant that moves the output visibly."""
    sizes: dict[str, float] = {}
    wanted = DOSE * rms(residual.fitted.residual)
    for question in questions:
        name = question.location.name
        if question.operator != "constant" or name in sizes:
            continue
        usual = question.location.usual
        moved = rms(
            find_secants(residual.fitted, [question.fix() | {question.prefix + "size": usual}])
        )
        times = wanted / moved if moved > 0.0 else 1.0
        sizes[name] = usual * float(np.clip(times, 1e-3, 1e2))
    return sizes


def _score_columns(residual: _Residual, question: Question, raw: Array) -> tuple[TermScore, _Sums]:
    """Score doses, shape (n, p), each per size."""
    columns = residual.clean(raw)
    products = residual.sum_products(np.column_stack([columns, residual.left]))
    sums = _Sums(products[:, :-1, :-1], products[:, :-1, -1])
    amounts = sums.fit_all()
    plain = np.ones((1, residual.stretches))
    explained = float(sums.predict(plain)[0]) / float(residual.left @ residual.left)
    score = TermScore(question, explained, tuple(map(float, amounts)), columns @ amounts)
    return score, sums


def _score_again(residual: _Residual, doses: Doses, score: TermScore) -> TermScore:
    """Score with a dose of the size that was found: a plant is not linear."""
    largest = max(score.amounts, key=abs)
    if score.question.is_following or score.explained <= 0.0 or largest == 0.0:
        return score
    columns = doses.simulate(score.question, largest)
    again, _ = _score_columns(residual, score.question, columns)
    return again if again.explained > score.explained else score
