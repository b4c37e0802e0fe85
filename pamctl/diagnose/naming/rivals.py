"""What else could it be: every named effect against the best other explanations.

Each effect of the chosen set is taken out, and the other candidates are tried in its place, by the
same score test and refit. A rival that is not clearly worse on the held-out records is an equal:
the data do not tell the two apart, and the verdict says so. Where the chosen effects leave nothing
above the floor, the data have also refuted a rival that leaves clearly more than its limit, and one
of which the best mixture of both models takes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import fit_model
from pamctl.diagnose.judging.mixture import Mixture, is_first_alone, mix_models
from pamctl.diagnose.naming.score import Score, score_candidates
from pamctl.diagnose.naming.search import (
    EffectSearch,
    confirm_complete,
    fit_to_end_if_near,
    rank,
    run_fit_jobs,
)
from pamctl.diagnose.naming.shortlist import select_promising
from pamctl.diagnose.naming.stretches import (
    MUCH,
    SURE,
    average_block_squares,
    average_squares_over_floor,
    draw_means,
    is_clearly_above,
)

MOST_RIVALS = 6
OFTEN = 0.2
"""A rival that leaves less in more of the replicas is not refuted by a limit: a limit has an edge.
"""
MOST_SERIOUS_RIVALS = 3
"""Rivals that are fitted to the end."""


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
    # What blocks disagree about shows in all of them, wherever the effect acts.
    judged = effect.blocks if search.alone is None else {*chosen.evidence.blocks}
    rivals, confidence = _judge_rivals(chosen, sorted(judged), models)
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
    chosen: Model, blocks: Sequence[str], models: dict[str, Model]
) -> tuple[tuple[Rival, ...], float]:
    """Return the judged rivals and the confidence, by a paired block bootstrap of mean squares."""
    names = list(models)
    rows = [average_squares_over_floor(m, blocks) for m in (chosen, *models.values())]
    means = np.log(draw_means(*rows))
    margins = means[1:] - means[0]
    is_complete = all(map(chosen.is_explained, chosen.evidence.blocks))
    rivals = tuple(
        Rival(
            name,
            max(models[name].ratio(b) for b in blocks),
            float(np.mean(margin < 0.0)),
            float(np.quantile(margin, SURE)) < MUCH
            and _is_worth_a_name(models[name], name)
            and (float(np.mean(margin < 0.0)) > OFTEN or not is_refuted(models[name], chosen))
            and not (is_complete and is_first_alone(_mix_blocks(chosen, models[name], blocks))),
        )
        for name, margin in zip(names, margins, strict=True)
    )
    confidence = float(np.mean((margins > 0.0).all(axis=0))) if names else 1.0
    return tuple(sorted(rivals, key=lambda r: r.residual_over_floor)), confidence


def _is_worth_a_name(rival: Model, name: str) -> bool:
    """Tell whether a rival has a size of its own: a line that hardly restricts is a volume."""
    return all(rival.is_substantial(c) for c in rival.effects if c.name == name)


def _mix_blocks(chosen: Model, rival: Model, blocks: Sequence[str]) -> list[Mixture]:
    """Return the best mixture of two models in each block, on the held-out records."""
    return [
        mix_models(
            chosen.residuals[b] / chosen.floors[b].mean,
            rival.residuals[b] / chosen.floors[b].mean,
            float(np.median(chosen.evidence.holdout[b][0].step_s)),
        )
        for b in blocks
    ]


def is_refuted(rival: Model, chosen: Model) -> bool:
    """Tell whether a rival leaves clearly more than its limit, where the chosen effects do not."""
    return any(
        chosen.is_explained(b)
        and not rival.is_explained(b)
        and is_clearly_above(average_block_squares(rival, b), rival.floors[b].limit)
        for b in chosen.evidence.blocks
    )
