"""Ask all questions of a residual, in output-error form, and rank them.

A dose of each term is simulated by the plant itself. What recalibration can imitate is projected
out of doses and residual. A term's score is the share of the residual's square that it predicts
of stretches that did not fit it: half of the stretches fit its amounts, the other half judges, and
the other way round. So a curve of five numbers has no advantage over a constant.

So many questions find something in any residual. The score that counts is what the best of all
questions reaches on residuals whose stretches have random signs: then nothing is left to be found.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pamctl.diagnose.fitting.block_fit import Fit, project_out, rms, secant
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.terms.grammar import Question

STRETCH_S = 1.0
"""Stretches that fit and judge in turn."""
FEWEST_STRETCHES = 8
SHUFFLES = 40
"""Residuals with random signs, from which the search's own score is known."""
RIDGE = 1e-4
"""Relative to the square of the columns: doses that recalibration imitates get small amounts."""
ROBUST = 10.0
"""Residuals above this multiple of the usual one count less."""
DOSE = 0.5
"""RMS of a dose's result, as a share of the residual's."""
MOST_RELINEARISED = 24
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
        self.basis: Array = (
            np.linalg.qr(weighed)[0] if movable else np.zeros((len(raw), 0))
        )
        self.left: Array = self.clean(raw)
        period_s = float(np.median(fitted.drives[0].step_s))
        length = max(min(round(STRETCH_S / period_s), len(raw) // FEWEST_STRETCHES), 1)
        self.edges = np.arange(0, len(raw), length)

    def clean(self, columns: Array) -> Array:
        """Weigh rows, and remove what recalibration imitates."""
        weights = self.weights if columns.ndim == 1 else self.weights[:, None]
        return project_out(self.basis, columns * weights)

    def sum_stretches(self, values: Array) -> Array:
        """Return sums over the stretches, shape (stretches, ...)."""
        sums: Array = np.add.reduceat(values, self.edges, axis=0)
        return sums


@dataclass(frozen=True)
class _Sums:
    """The normal equations of one question, by stretch."""

    squares: Array
    """Of columns by columns, shape (stretches, p, p)."""
    products: Array
    """Of columns by the residual, shape (stretches, p)."""

    def predict(self, signs: Array) -> float:
        """Return by how much the amounts of each half reduce the square of the other half."""
        gained = 0.0
        halves = np.arange(len(self.products)) % 2 == 0
        for fit in (halves, ~halves):
            amounts = self.solve(fit, signs)
            judged = self.squares[~fit].sum(axis=0)
            product = (signs[~fit, None] * self.products[~fit]).sum(axis=0)
            gained += 2.0 * float(amounts @ product) - float(amounts @ judged @ amounts)
        return gained

    def solve(self, rows: Array, signs: Array) -> Array:
        """Return the amounts that fit some of the stretches best."""
        squares = self.squares[rows].sum(axis=0)
        product = (signs[rows, None] * self.products[rows]).sum(axis=0)
        scale = np.sqrt(np.maximum(np.diag(squares), 1e-300))
        scaled = squares / np.outer(scale, scale) + RIDGE * np.eye(len(scale))
        amounts: Array = np.linalg.solve(scaled, product / scale) / scale
        return amounts


def rank_terms(fitted: Fit, block: str, questions: Sequence[Question]) -> TermRanking:
    """Score all questions on a block's fit, the best first; see the module's text."""
    residual = _Residual(fitted)
    sizes = _choose_sizes(residual, questions)
    total = float(residual.left @ residual.left)
    random = np.random.default_rng(17)
    signs = random.choice([-1.0, 1.0], (SHUFFLES, len(residual.edges)))
    by_chance = np.zeros(SHUFFLES)
    scores: list[TermScore] = []
    for question in questions:
        size = sizes[question.location.name] / question.typical_shape()
        score, sums = _score_dose(residual, question, 1.0 if question.is_following else size)
        scores.append(score)
        by_chance = np.maximum(by_chance, [sums.predict(s) / total for s in signs])
    scores.sort(key=lambda s: -s.explained)
    first = [_score_again(residual, s) for s in scores[:MOST_RELINEARISED]]
    ranked = sorted((*first, *scores[MOST_RELINEARISED:]), key=lambda s: -s.explained)
    chance = float(np.max(by_chance))
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
        moved = rms(secant(residual.fitted, question.fix() | {question.prefix + "size": usual}))
        times = wanted / moved if moved > 0.0 else 1.0
        sizes[name] = usual * float(np.clip(times, 1e-3, 1e2))
    return sizes


def build_doses(question: Question, size: float) -> Iterator[dict[str, float]]:
    """Yield the values of each of the question's shapes at a size."""
    for shape in question.list_shapes():
        named = {question.prefix + name: value for name, value in shape.items()}
        yield question.fix() | named | {question.prefix + "size": size}


def _score_dose(
    residual: _Residual, question: Question, size: float
) -> tuple[TermScore, _Sums]:
    moved = [secant(residual.fitted, dose) / size for dose in build_doses(question, size)]
    columns = residual.clean(np.nan_to_num(np.column_stack(moved)))
    squares = residual.sum_stretches(columns[:, :, None] * columns[:, None, :])
    sums = _Sums(squares, residual.sum_stretches(columns * residual.left[:, None]))
    plain = np.ones(len(residual.edges))
    amounts = sums.solve(np.ones(len(plain), dtype=bool), plain)
    explained = sums.predict(plain) / float(residual.left @ residual.left)
    score = TermScore(question, explained, tuple(map(float, amounts)), columns @ amounts)
    return score, sums


def _score_again(residual: _Residual, score: TermScore) -> TermScore:
    """Score with a dose of the size that was found: a plant is not linear."""
    if score.question.is_following or score.explained <= 0.0:
        return score
    largest = max(score.amounts, key=abs)
    if largest == 0.0:
        return score
    again, _ = _score_dose(residual, score.question, largest)
    return again if again.explained > score.explained else replace(score)
