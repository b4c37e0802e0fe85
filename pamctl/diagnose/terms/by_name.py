"""Terms that the catalogue has under a name: the effect, fitted from where the term ended.

Some effects only a term finds: a fit of a ripple needs its frequency to start from. The effect that
leaves as little as the term has the name. It is said only where no term of another place leaves as
little as well.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pamctl.diagnose.fitting.block_fit import FULL
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import estimate_intervals
from pamctl.diagnose.fitting.model_fit import fit_jointly, fit_model
from pamctl.diagnose.fitting.numbers import numbers_of_effect
from pamctl.diagnose.name import Naming
from pamctl.diagnose.naming.doubt import is_strained
from pamctl.diagnose.naming.rivals import Rival, Standing
from pamctl.diagnose.naming.score import clip_inside
from pamctl.diagnose.naming.stretches import (
    average_squares_over_floor,
    draw_means,
    gains_in_block,
)
from pamctl.diagnose.naming.verdict import Verdict, spoils_block
from pamctl.diagnose.terms.trials import NEAR_BEST, TermTrial, list_equals
from pamctl.diagnose.terms.words import list_kin
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.description import EffectDescription

MOST_RIVALS = 6


@dataclass(frozen=True)
class _Found:
    candidate: Candidate
    model: Model


def name_instead(
    naming: Naming,
    before: Model,
    chosen: TermTrial,
    trials: Sequence[TermTrial],
    block: str,
    without: Collection[str] = (),
) -> Naming | None:
    """Return the naming with an effect in place of the chosen term; None where none fits as well.

    `before` is the model beside which the term was fitted, `trials` are all terms that were.
    """
    equals = list_equals(chosen, trials)
    if any(t.question.location != chosen.question.location for t in equals):
        return None
    found = [
        result
        for trial in (chosen, *equals)
        for result in _fit_effects(before, trial, without)
        if _fits_as_well(before, result.model, chosen.model, block)
    ]
    if not found:
        return None
    best = min(found, key=lambda f: f.model.rms[block])
    kept = tuple(s for s in naming.standings if s.effect in before.effects)
    standing = _hold_against_terms(naming, best, trials)
    return replace(
        naming,
        verdict=Verdict.NAMED if best.model.is_complete else Verdict.PARTIAL,
        model=best.model,
        standings=(*kept, standing),
        numbers=estimate_intervals(best.model),
    )


def _fit_effects(before: Model, trial: TermTrial, without: Collection[str]) -> list[_Found]:
    """Fit every effect that says where it would start from this term."""
    nominal = before.evidence.nominal
    taken = {*without, *before.names, *nominal.acting}
    values = trial.own_values
    return [
        _fit_effect(before, effect, kin.numbers(values))
        for effect, kin in list_kin(trial.question)
        if kin.numbers is not None
        and effect.name not in taken
        and nominal.actuator in effect.actuators
    ]


def _fit_effect(before: Model, effect: EffectDescription, start: Mapping[str, float]) -> _Found:
    candidate = _make_candidate(effect, before.evidence)
    inside = {
        f.name: clip_inside(start[f.name.split(".")[1]], f.low, f.high, f.scale)
        for f in candidate.free
    }
    effects = (*before.effects, candidate)
    model = fit_model(before, effects, [{**before.effect_values, **inside}], effort=FULL)
    return _Found(candidate, fit_jointly(model) if model.is_complete else model)


def _make_candidate(effect: EffectDescription, evidence: Evidence) -> Candidate:
    names = [p.name for p in effect.parameters]
    free = numbers_of_effect(effect.name, names, evidence.nominal, evidence.reach)
    reached = frozenset(b for b in effect.seen_by if b in evidence.blocks)
    return Candidate(effect.name, effect.name, free, (), reached)


def _fits_as_well(before: Model, model: Model, term: Model, block: str) -> bool:
    return (
        model.is_plausible
        and not is_strained(model)
        and model.rms[block] <= (1.0 + NEAR_BEST) * term.rms[block]
        and (model.is_explained(block) or not gains_in_block(model, term, block))
        and not spoils_block(before, model)
    )


def _hold_against_terms(naming: Naming, found: _Found, trials: Sequence[TermTrial]) -> Standing:
    """Return how the effect stands: against sets of the catalogue, and in replicas against terms.

    The terms of its own place say the same: only those of other places count.
    """
    size = len(found.model.effects)
    kin = {t.location for t in CATALOGUE[found.candidate.name].as_terms}
    rows = [
        average_squares_over_floor(m, sorted(found.candidate.blocks))
        for m in (
            found.model,
            *(t.model for t in trials if t.question.location.name not in kin),
        )
    ]
    means = draw_means(*rows)
    rivals = tuple(
        Rival(trial.names[-1], max(trial.ratios[b] for b in found.candidate.blocks), 0.0, False)
        for trial in naming.trials
        if len(trial.names) == size
    )
    return Standing(
        found.candidate,
        tuple(sorted(rivals, key=lambda r: r.residual_over_floor)[:MOST_RIVALS]),
        float(np.mean((means[1:] > means[0]).all(axis=0))) if len(rows) > 1 else 1.0,
    )
