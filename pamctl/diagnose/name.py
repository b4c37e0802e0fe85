"""Step 3, name: which effects are missing, and what else it could be.

`naming/search.py` grows sets of effects. Here the best set is held against its rivals. Where its
numbers put a set in doubt, the part of it that is credible remains.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import FittedNumber, estimate_intervals, widen_by_forms
from pamctl.diagnose.fitting.model_fit import fit_model, wrap_nominal_model
from pamctl.diagnose.naming.doubt import has_doubtful_effect
from pamctl.diagnose.naming.rivals import Standing, find_rivals
from pamctl.diagnose.naming.search import EffectSearch, EffectsTrial, Progress, search_effects
from pamctl.diagnose.naming.stretches import gains_in_block
from pamctl.diagnose.naming.unseen import hold_unseen_numbers
from pamctl.diagnose.naming.verdict import (
    Judgement,
    Verdict,
    judge_parts,
    judge_search,
    revise_verdict,
)


@dataclass(frozen=True)
class Naming:
    """What was named, and what it rests on."""

    verdict: Verdict
    base: Model
    """The recalibrated model, without any effect."""
    model: Model
    """With the named effects."""
    standings: tuple[Standing, ...]
    numbers: tuple[FittedNumber, ...]
    trials: tuple[EffectsTrial, ...]
    """Every set of effects that was fitted, the best first."""

    def without_unseen_numbers(self) -> Naming:
        """Return the naming with numbers that no record shows as the plant file has them."""
        model = hold_unseen_numbers(self.model)
        if model is self.model:
            return self
        return replace(self, model=model, numbers=estimate_intervals(model))

    def withdraw_effects(self, names: Collection[str]) -> Naming:
        """Return the naming without these effects. What remains explains a part, or nothing."""
        kept = tuple(c for c in self.model.effects if c.name not in names)
        standings = tuple(s for s in self.standings if s.effect in kept)
        model, verdict = self.base, Verdict.NONE_KNOWN
        if kept:
            fitted = fit_model(self.base, kept, [self.model.effect_values])
            model = hold_unseen_numbers(fitted)
            verdict = revise_verdict(Judgement(Verdict.PARTIAL, model), standings)
        numbers = estimate_intervals(model)
        return replace(self, verdict=verdict, model=model, standings=standings, numbers=numbers)


def name_effects(
    base: Model,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Progress,
    known: Iterable[Model] = (),
) -> Naming:
    """Name what a recalibrated model lacks, or say that nothing known explains the rest.

    `known` are models of single blocks that were fitted before.
    """
    search = search_effects(base, candidates, executor, progress, known=known)
    nominal = wrap_nominal_model(search.base.evidence)

    def compare(
        search: EffectSearch, judge: Callable[[EffectSearch], Judgement]
    ) -> tuple[EffectSearch, Judgement, tuple[Standing, ...]]:
        return _compare_with_rivals(search, judge, candidates, executor, progress)

    search, judgement, standings = compare(search, lambda s: judge_search(s, nominal))
    numbers = estimate_intervals(judgement.model)
    named = judgement.verdict is Verdict.NAMED
    if named and has_doubtful_effect(judgement.model, search, numbers):
        names = judgement.model.names
        search, judgement, standings = compare(search, lambda s: judge_parts(s, names))
        numbers = estimate_intervals(judgement.model)
    base = hold_unseen_numbers(search.base)
    model = hold_unseen_numbers(judgement.model) if judgement.model.effects else base
    if model is not judgement.model:
        numbers = estimate_intervals(model)
    return Naming(
        revise_verdict(judgement, standings),
        base,
        model,
        standings,
        widen_by_forms(numbers, _list_equals(judgement.model, standings, search)),
        search.list_trials(),
    )


def _compare_with_rivals(
    search: EffectSearch,
    judge: Callable[[EffectSearch], Judgement],
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Progress,
) -> tuple[EffectSearch, Judgement, tuple[Standing, ...]]:
    """Judge the search and fit the rivals; where a rival does better, fit that one's rivals."""
    judgement = judge(search)
    standings: tuple[Standing, ...] = ()
    while judgement.model.effects:
        progress("fitting the rivals of " + " and ".join(judgement.model.names))
        standings = find_rivals(judgement.model, search, candidates, executor)
        search = search.add_models(m for standing in standings for m in standing.rival_models)
        before, judgement = judgement, judge(search)
        if judgement.model.effects == before.model.effects:
            break
    return search, judgement, standings if judgement.model.effects else ()


def _list_equals(model: Model, standings: Sequence[Standing], search: EffectSearch) -> list[Model]:
    """Return the models that may as well be true: other forms, equal rivals, and larger sets.

    A larger set that leaves less shows what the numbers would be with something else beside them.
    """
    if not model.effects:
        return []
    names = {*model.names}
    equal = {name for standing in standings for name in standing.equal_rivals}
    rivals = [m for s in standings for m in s.rival_models if equal & {*m.names}]
    kin = [m for m in search.models if {*m.names} >= names and m is not model]
    blocks = {b for c in model.effects for b in c.blocks}
    return [*rivals, *(m for m in kin if not any(gains_in_block(m, model, b) for b in blocks))]
