"""What else could it be: every named effect against the best other explanations.

Each effect of the chosen set is taken out, and the other candidates are tried in its place, by the
same score test and refit. A rival that is not clearly worse on the held-out records is an equal:
the data do not tell the two apart, and the verdict says so. Where the chosen effects leave nothing
above the floor, the data have refuted any rival that leaves something.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import fit_model
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.score import Score, score_candidates
from pamctl.diagnose.naming.search import (
    EffectSearch,
    confirm_complete,
    fit_to_end_if_near,
    rank,
    run_fit_jobs,
)
from pamctl.diagnose.naming.shortlist import select_promising

MOST_RIVALS = 6
MOST_SERIOUS_RIVALS = 3
"""Rivals that are fitted to the end."""
STRETCH_S = 0.25
REPLICAS = 400
MUCH = 0.05
"""A rival is clearly worse if the log of its mean square is larger by this much in 98 of 100
replicas."""


@dataclass(frozen=True)
class Rival:
    """Another explanation for one effect."""

    name: str
    residual_over_floor: float
    wins: float
    """Share of the bootstrap replicas in which it leaves less."""
    is_equal: bool


@dataclass(frozen=True)
class Standing:
    """How one effect of the chosen set stands against its rivals."""

    effect: Candidate
    rivals: tuple[Rival, ...]
    confidence: float
    """Share of the bootstrap replicas in which it beats every rival."""
    rival_models: tuple[Model, ...] = ()

    @property
    def equal_rivals(self) -> tuple[str, ...]:
        """Rivals that the data do not tell apart from it."""
        return tuple(r.name for r in self.rivals if r.is_equal)


def find_rivals(
    chosen: Model,
    search: EffectSearch,
    candidates: Sequence[Candidate],
    executor: Executor | None = None,
) -> tuple[Standing, ...]:
    """Return every effect of the chosen model with its rivals, the nearest first."""
    return tuple(
        _find_rivals_of_effect(chosen, effect, search, candidates, executor)
        for effect in chosen.effects
    )


def _find_rivals_of_effect(
    chosen: Model,
    effect: Candidate,
    search: EffectSearch,
    candidates: Sequence[Candidate],
    executor: Executor | None,
) -> Standing:
    others = tuple(c for c in chosen.effects if c != effect)
    without = fit_model(search.base, others, [chosen.effect_values])
    tried = _find_tried_models(search, chosen, effect)
    known = {candidate for candidate, _ in tried}
    jobs = [
        (without, score)
        for score in _score_rivals(without, effect, candidates, chosen)
        if score.candidate not in known
    ]
    fitted = run_fit_jobs(_fit_rival, jobs, executor)
    tried += [(score.candidate, m) for (_, score), m in zip(jobs, fitted, strict=True)]
    models: dict[str, Model] = {}
    for candidate, model in sorted(tried, key=lambda pair: rank(pair[1])):
        models.setdefault(candidate.name, model)  # the best form of each name
    for name in [*models][:MOST_SERIOUS_RIVALS]:
        models[name] = confirm_complete(fit_to_end_if_near(models[name]))
    rivals, confidence = _judge_rivals(chosen, effect, models)
    return Standing(effect, rivals, confidence, tuple(models.values()))


def _find_tried_models(
    search: EffectSearch, chosen: Model, effect: Candidate
) -> list[tuple[Candidate, Model]]:
    """Return models of the search that differ from the chosen one in this effect only."""
    kept = {*chosen.names} - {effect.name}
    return [
        (next(c for c in model.effects if c.name not in kept), model)
        for model in search.models
        if len(model.effects) == len(chosen.effects)
        and kept < {*model.names}
        and effect.name not in model.names
    ]


def _score_rivals(
    without: Model, effect: Candidate, candidates: Sequence[Candidate], chosen: Model
) -> list[Score]:
    others = [c for c in candidates if c.name not in chosen.names and c.blocks & effect.blocks]
    best = {
        s.candidate: s
        for block in effect.blocks
        for s in select_promising(
            score_candidates(without.fit_of(block), others, block), MOST_RIVALS
        )
    }
    return [*best.values()]


def _fit_rival(job: tuple[Model, Score]) -> Model:
    without, score = job
    return fit_model(without, (*without.effects, score.candidate), [score.start])


def _judge_rivals(
    chosen: Model, effect: Candidate, models: dict[str, Model]
) -> tuple[tuple[Rival, ...], float]:
    """Return the judged rivals and the confidence, by a paired block bootstrap of mean squares."""
    names = list(models)
    blocks = sorted(effect.blocks)
    own = _mean_squares(chosen, blocks)
    others = np.array([_mean_squares(models[n], blocks) for n in names]).reshape(
        len(names), len(own)
    )
    random = np.random.default_rng(7)
    picks = random.integers(0, len(own), (REPLICAS, len(own)))
    margins = np.log(others[:, picks].mean(axis=2)) - np.log(own[picks].mean(axis=1))
    rivals = []
    for index, name in enumerate(names):
        low = float(np.quantile(margins[index], 0.02))
        model = models[name]
        rivals.append(
            Rival(
                name,
                max(model.ratio(b) for b in blocks),
                float(np.mean(margins[index] < 0.0)),
                low < MUCH and bool(chosen.unexplained or not model.unexplained),
            )
        )
    confidence = float(np.mean((margins > 0.0).all(axis=0))) if names else 1.0
    return tuple(sorted(rivals, key=lambda r: r.residual_over_floor)), confidence


def _mean_squares(model: Model, blocks: Sequence[str]) -> Array:
    """Return held-out mean squares over stretches, each block in units of its floor, shape (m,)."""
    pieces = []
    for block in blocks:
        residual = model.residuals[block] / model.floors[block].mean
        period_s = float(np.median(model.evidence.holdout[block][0].step_s))
        length = max(int(STRETCH_S / period_s), 1)
        whole = residual[: len(residual) // length * length]
        pieces.append((whole.reshape(-1, length) ** 2).mean(axis=1))
    return np.concatenate(pieces)
