"""Step 3, name: which effects are missing, and what else it could be.

`naming/search.py` grows sets of effects. Here the best set is held against its rivals, and a
name that the numbers or the rivals put in doubt is withdrawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import FittedNumber, estimate_intervals
from pamctl.diagnose.fitting.model_fit import wrap_nominal_model
from pamctl.diagnose.naming.doubt import has_doubtful_effect
from pamctl.diagnose.naming.rivals import Standing, find_rivals
from pamctl.diagnose.naming.search import EffectSearch, EffectsTrial, Progress, search_effects
from pamctl.diagnose.naming.verdict import Judgement, Verdict, judge_search, revise_verdict


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
    explained: float
    """Share of the gap from recalibrated to floor that the effects close; 0 without effects."""
    trials: tuple[EffectsTrial, ...]
    """Every set of effects that was fitted, the best first."""

    def withdraw_effects(self) -> Naming:
        """Return the naming that names nothing."""
        return replace(
            self,
            verdict=Verdict.NONE_KNOWN,
            model=self.base,
            standings=(),
            numbers=estimate_intervals(self.base),
            explained=0.0,
        )


def name_effects(
    base: Model, candidates: Sequence[Candidate], executor: Executor | None, progress: Progress
) -> Naming:
    """Name what a recalibrated model lacks, or say that nothing known explains the rest."""
    search = search_effects(base, candidates, executor, progress)
    search, judgement, standings = _compare_with_rivals(search, candidates, executor, progress)
    model = judgement.model
    verdict = revise_verdict(judgement, standings)
    naming = Naming(
        verdict,
        search.base,
        model,
        standings,
        estimate_intervals(model),
        judgement.explained if model.effects else 0.0,
        search.list_trials(),
    )
    doubtful = verdict is not Verdict.PARTIAL and has_doubtful_effect(model, search, naming.numbers)
    if model.effects and (doubtful or verdict is Verdict.NONE_KNOWN):
        return naming.withdraw_effects()
    return naming


def _compare_with_rivals(
    search: EffectSearch,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Progress,
) -> tuple[EffectSearch, Judgement, tuple[Standing, ...]]:
    """Judge the search and fit the rivals; where a rival does better, fit that one's rivals."""
    nominal = wrap_nominal_model(search.base.evidence)
    judgement = judge_search(search, nominal)
    standings: tuple[Standing, ...] = ()
    while judgement.verdict in (Verdict.NAMED, Verdict.PARTIAL):
        progress("fitting the rivals of " + " and ".join(judgement.model.names))
        standings = find_rivals(judgement.model, search, candidates, executor)
        search = search.add_models(m for standing in standings for m in standing.rival_models)
        before, judgement = judgement, judge_search(search, nominal)
        if judgement.model.effects == before.model.effects:
            break
    return search, judgement, standings
