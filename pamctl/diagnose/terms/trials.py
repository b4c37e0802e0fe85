"""Fit the most promising terms in the plant, and choose the simplest of the best.

The same fits, floors and held-out samples judge them as judge the effects of the catalogue.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from math import atan2, hypot, pi

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.fitting.block_fit import FULL
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model, extract_block_fit
from pamctl.diagnose.fitting.model_fit import fit_model
from pamctl.diagnose.fitting.numbers import FreeNumber
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.search import rank, run_fit_jobs
from pamctl.diagnose.naming.stretches import gains_in_block
from pamctl.diagnose.terms.grammar import Question, list_questions
from pamctl.diagnose.terms.term_score import TermRanking, TermScore, rank_terms
from pamctl.plant.terms.operators import KNOTS

MOST_FITTED = 8
"""Groups of terms whose first is fitted in the plant."""
MOST_FINISHED = 2
ROUNDS_ELSEWHERE, MOST_ELSEWHERE = 2, 3
"""How often, and of how many other places, it is asked whether they do what the best term does,
where that leaves something."""
MOST_LEFT = 0.5
"""The best term then leaves at most this share: it is beside the truth, not far from it."""
WIDE = 10.0
"""A size may grow to this multiple of what the score suggests."""
INNER_FACTOR = 4.0
"""An inner number may move by this factor: more than the grid of questions is wide."""
WAVE_SHARE = 0.25
"""A period may move by this share."""
MOST_KNOT = 20.0
UNSHOWN = 1e-6
"""A knot whose amount is below this share of the largest changes nothing in these records."""
FLOOR_GROWS = 1.5
"""A term's own floor is believed up to this multiple of the recalibrated model's."""
NEAR_SCORE = 0.15
"""A simpler term of a group is fitted too if it explains at most this much less."""
WORTH_FINISHING = 3.0
"""A term that leaves more than this multiple of what the best one leaves is not fitted further."""
NEAR_BEST = 0.1
"""A term with fewer numbers counts as equally good if it leaves at most this share more."""


@dataclass(frozen=True)
class TermTrial:
    """A term that was fitted in the plant, beside a model's effects."""

    score: TermScore
    model: Model

    @property
    def candidate(self) -> Candidate:
        """The term as the fit has it: the last of the model's effects."""
        return self.model.effects[-1]

    @property
    def question(self) -> Question:
        """The term."""
        return self.score.question

    @property
    def values(self) -> dict[str, float]:
        """The term's numbers by full name, held and fitted."""
        return {**dict(self.candidate.held), **self.model.effect_values}

    @property
    def own_values(self) -> dict[str, float]:
        """The term's numbers by their own names."""
        prefix = self.question.prefix
        return {n.removeprefix(prefix): v for n, v in self.values.items() if n.startswith(prefix)}


def find_terms(
    before: Model, block: str, executor: Executor | None = None
) -> tuple[TermRanking, tuple[TermTrial, ...]]:
    """Ask all questions of what a model leaves of a block; fit the best, the nearest first."""
    fitted = extract_block_fit(before.fit_of(block), block)
    taken = {c.name for c in before.effects} | {*before.evidence.nominal.acting}
    questions = list_questions(block, fitted.drives, before.evidence.nominal, taken)
    ranking = rank_terms(fitted, block, questions)
    trials = _fit_scores(before, block, _select_scores(ranking), executor)
    for _ in range(ROUNDS_ELSEWHERE):
        nearest = min(trials, key=lambda t: t.model.rms[block], default=None)
        if nearest is None or not _is_beside(nearest, before, block):
            break
        again = rank_terms(fitted, block, _ask_elsewhere(nearest, questions))
        known = {t.question.key for t in trials}
        others = [s for s in again.scores if s.question.key not in known][:MOST_ELSEWHERE]
        trials = _fit_scores(before, block, others, executor, trials)
    return ranking, tuple(trials)


def _fit_scores(
    before: Model,
    block: str,
    scores: Sequence[TermScore],
    executor: Executor | None,
    known: Sequence[TermTrial] = (),
) -> list[TermTrial]:
    """Fit terms, those near the best to the end; return them with the known ones, best first."""
    jobs = [(before, score) for score in scores]
    models = run_fit_jobs(_fit_size, jobs, executor)
    trials = sorted(map(TermTrial, scores, models), key=lambda t: rank(t.model))
    best = min((t.model.rms[block] for t in (*trials, *known)), default=0.0)
    near = [t for t in trials[:MOST_FINISHED] if t.model.rms[block] <= WORTH_FINISHING * best]
    ended = run_fit_jobs(_finish, [(before, t) for t in near], executor)
    return sorted((*known, *ended, *trials[len(near) :]), key=lambda t: rank(t.model))


def _is_beside(nearest: TermTrial, before: Model, block: str) -> bool:
    """Tell whether a term with an inner number explains most of a block, and not all."""
    model = nearest.model
    explains_most = model.rms[block] < MOST_LEFT * before.rms[block]
    return explains_most and not model.is_explained(block) and "inner" in nearest.question.held


def _ask_elsewhere(found: TermTrial, questions: Sequence[Question]) -> list[Question]:
    """Return a term's operator and driver at every place, with the inner number that it found.

    The grid of inner numbers is coarse: at the instant that a fit has found, another place may
    explain all of it.
    """
    term = found.question
    inner = {"inner": found.own_values["inner"]}
    same = {
        q.location.name: replace(q, held=inner)
        for q in questions
        if (q.operator, q.driver) == (term.operator, term.driver)
    }
    sizes = [q for q in questions if q.operator == "constant" and q.location.name in same]
    return [*sizes, *same.values()]


def _select_scores(ranking: TermRanking) -> list[TermScore]:
    """Return the first term of each group, and those like it that are simpler or seen elsewhere.

    What both blocks see can be told from what only one sees, though not in this block. Of one term
    with several inner numbers only the best is fitted.
    """
    kept: dict[tuple[str, str, str], TermScore] = {}
    for group in ranking.group(3 * MOST_FITTED):
        first = group[0]
        kept.setdefault(first.question.key, first)
        simple = [
            s
            for s in group
            if _count_numbers(s) < _count_numbers(first)
            and s.explained >= first.explained - NEAR_SCORE
        ]
        wider = [s for s in group if _count_blocks(s) > _count_blocks(first)]
        for score in (*sorted(simple, key=_count_numbers)[:1], *wider[:1]):
            kept.setdefault(score.question.key, score)
    return [*kept.values()][:MOST_FITTED]


def _fit_size(job: tuple[Model, TermScore]) -> Model:
    """Fit a term's size and inner number; a curve keeps the shape of its score."""
    before, score = job
    candidate = make_candidate(score, before, start_of(score), is_bent=False)
    return fit_model(before, (*before.effects, candidate), [before.effect_values])


def _finish(job: tuple[Model, TermTrial]) -> TermTrial:
    """Fit a term to the end, with all its numbers."""
    before, trial = job
    # From the base's numbers the way is long: friction and stiffness are those without the term.
    start = {**dict(trial.candidate.held), **trial.model.values}
    own = {n: v for n, v in start.items() if n.startswith(trial.question.prefix)}
    candidate = make_candidate(trial.score, before, own, is_bent=True)
    effects = (*before.effects, candidate)
    return TermTrial(trial.score, doubt_own_floor(fit_model(before, effects, [start], effort=FULL)))


def doubt_own_floor(model: Model) -> Model:
    """Return the model, with the recalibrated model's floor where its own is far higher.

    Of a term with many numbers some may be anything, together with a recalibrated number. Noise
    then seems to move them far, and the floor that this makes would excuse any residual.
    """
    root = model.root
    if root is None or all(
        model.floors[b].mean <= FLOOR_GROWS * root.floors[b].mean for b in model.evidence.blocks
    ):
        return model
    return replace(model, is_final=False)


def start_of(score: TermScore) -> dict[str, float]:
    """Return the numbers from which a term's fit starts, by full name."""
    question, amounts = score.question, score.amounts
    prefix = question.prefix
    if question.operator == "wave":
        values = {"size": hypot(*amounts), "phase": atan2(amounts[1], amounts[0])}
    elif question.operator == "curve":
        size = max(amounts, key=abs)
        values = {"size": size}
        if size:
            knots = spread_to_unshown(amounts) / size
            values |= {f"knot_{k}": float(knot) for k, knot in enumerate(knots, 1)}
    else:
        values = {"size": amounts[0]}
    return {prefix + name: value for name, value in {**question.held, **values}.items()}


def find_shown_knots(amounts: Sequence[float]) -> NDArray[np.bool_]:
    """Mark the knots of a curve that the records show: one that moves nothing has no amount.

    Friction of contraction shows nothing at speeds of the other sign. Such a knot follows its
    neighbours: at any value of its own it would spoil what is simulated elsewhere.
    """
    sizes = np.abs(np.asarray(amounts))
    return np.asarray(sizes > UNSHOWN * sizes.max(initial=0.0))


def spread_to_unshown(amounts: Sequence[float]) -> Array:
    """Return the amounts of a curve's knots; one that nothing shows lies between its neighbours."""
    shown = np.flatnonzero(find_shown_knots(amounts))
    spread: Array = np.interp(np.arange(len(amounts)), shown, np.asarray(amounts)[shown])
    return spread


def make_candidate(
    score: TermScore, before: Model, start: Mapping[str, float], *, is_bent: bool
) -> Candidate:
    """Return a term as a candidate of the search, with ranges around its start.

    `held` has every number's start. Of a curve the largest knot stays 1: the size is then the
    curve's largest value. The others move only if `is_bent`.
    """
    question, prefix = score.question, score.question.prefix
    size = start[prefix + "size"]
    ends = sorted((-0.2 * WIDE * size, WIDE * size))
    free = [FreeNumber(prefix + "size", ends[0], ends[1], 0.05 * abs(size))]
    if "inner" in question.held:
        free.append(_free_inner(prefix, question, start[prefix + "inner"]))
    if question.operator == "wave":
        free.append(FreeNumber(prefix + "phase", -2.0 * pi, 2.0 * pi, 0.05))
    if question.operator == "curve" and is_bent:
        free += [
            FreeNumber(name, -MOST_KNOT, MOST_KNOT, 0.05)
            for name, is_shown in zip(
                (f"{prefix}knot_{k}" for k in range(1, KNOTS + 1)),
                find_shown_knots(score.amounts),
                strict=True,
            )
            if is_shown and start.get(name) != 1.0
        ]
    held = {**question.fix(), **start}
    return Candidate(
        question.location.term_name,
        f"{question.operator} of {question.driver}",
        tuple(free),
        tuple(held.items()),
        frozenset(question.location.seen_by) & {*before.evidence.blocks},
    )


def _free_inner(prefix: str, question: Question, inner: float) -> FreeNumber:
    low, high, scale = inner / INNER_FACTOR, inner * INNER_FACTOR, 0.05 * inner
    if question.operator == "wave":
        low, high = inner * (1.0 - WAVE_SHARE), inner * (1.0 + WAVE_SHARE)
        scale = 0.02 * inner * min(inner / question.span.width, 1.0)
    if question.operator in ("beyond", "onset"):
        low = question.span.low + 0.02 * question.span.width
        high = question.span.high - 0.02 * question.span.width
        scale = 0.01 * question.span.width
    return FreeNumber(prefix + "inner", low, high, scale)


def _count_blocks(score: TermScore) -> int:
    return len(score.question.location.seen_by)


def choose_simplest(trials: Sequence[TermTrial]) -> TermTrial:
    """Return the term with the fewest numbers among those that leave hardly more than the best."""
    best = trials[0]
    blocks = best.model.evidence.blocks
    good = [t for t in trials if all(_is_as_good(t.model, best.model, b) for b in blocks)]
    return min(good, key=lambda t: (_count_numbers(t.score), rank(t.model)))


def _is_as_good(model: Model, best: Model, block: str) -> bool:
    return model.rms[block] <= (1.0 + NEAR_BEST) * best.rms[block] and (
        model.is_explained(block) or not best.is_explained(block)
    )


def _count_numbers(score: TermScore) -> int:
    return len(score.amounts) + len(score.question.held)


def list_equals(chosen: TermTrial, trials: Sequence[TermTrial]) -> tuple[TermTrial, ...]:
    """Return the terms that the held-out data of no block tell from the chosen one."""
    blocks = chosen.model.evidence.blocks
    return tuple(
        t
        for t in trials
        if t.question.key != chosen.question.key
        and not any(gains_in_block(t.model, chosen.model, b) for b in blocks)
    )
