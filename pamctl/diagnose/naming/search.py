"""Which effects are missing: the smallest set that brings every block to its floor.

Shortlist by score test, refit, judge on held-out records. A set of effects is complete
when nothing is left above the floor's limit. Where no effect of the shortlist alone is, all
others are fitted too. Sets grow one effect at a time from the best few of the level before:
two effects can each look poor alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import TypeVar

from pamctl.diagnose.fitting.block_fit import FULL
from pamctl.diagnose.fitting.candidates import (
    Candidate,
    apply_dose,
    generate_doses,
    select_reaching,
)
from pamctl.diagnose.fitting.fitted_model import Model, fit_jointly, fit_model, fit_to_end
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.naming.score import Score, clip_inside, score_candidates

SHORTLIST = 6
"""Candidates refitted for each unexplained block, and as many again that reach both."""
NARROWEST = 4
"""Of later levels, which grow from fewer models: a spool promises less than a delay at first."""
BEAM = 3
"""Models of a level that the next one grows from."""
NEAR_LIMITS = 4.0
"""A quick fit within so many limits is driven on."""
MOST_FINISHED = 3
"""So many of a level, at most."""
EQUAL_MARGIN = 0.1
"""A simpler form does as well that leaves so little more, counted from the floor to its limit."""
HOPELESS_SHARE = 0.2
"""Beyond the third a candidate must promise so much of what the first one does."""
WORTH_ANOTHER_EFFECT = 1.15
"""Another effect is asked for where so many limits are left: below, it would mend a form, or
what both blocks disagree about."""
MOST_REFORMED = 2
"""So many models of a level are tried in other forms of their last effect."""
SEVERAL_STARTS = 2
"""So many of a shortlist are fitted from several starts."""
MOST_EFFECTS = 3
MOST_EFFECTS_IN_BLOCK = 2
"""Three free structures in one block fit anything."""
NEAR_FORM = 0.15
"""A form of an effect that promises less than its best one by more is not fitted."""
PROMISE = 0.02
"""Share of the residual that a candidate must promise."""

Progress = Callable[[str], None]
Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class EffectSearch:
    """What was tried: models of every level, the best first within each."""

    base: Model
    levels: tuple[tuple[Model, ...], ...]

    @property
    def complete(self) -> tuple[Model, ...]:
        """Models that leave nothing, of the fewest effects that can."""
        for level in ((self.base,), *self.levels):
            done = tuple(m for m in level if m.is_complete)
            if done:
                return done
        return ()

    @property
    def best(self) -> Model:
        """The model that leaves least; of those that leave nothing, the best fit."""
        if self.complete:
            return _choose_simplest(self.complete)
        return self.nearest

    @property
    def nearest(self) -> Model:
        """The best fit, whatever numbers it needs; of those that leave nothing, if any do."""
        if self.complete:
            return self.complete[0]
        return min((self.base, *(m for level in self.levels for m in level)), key=rank)

    def add_models(self, heard: Iterable[Model]) -> EffectSearch:
        """Return the search with more models, each among those of as many effects."""
        levels = [[*level] for level in self.levels]
        for model in heard:
            level = levels[len(model.effects) - 1]
            if all({*model.effects} != {*known.effects} for known in level):
                level.append(model)
        return EffectSearch(self.base, tuple(tuple(sorted(level, key=rank)) for level in levels))


def _choose_simplest(complete: Sequence[Model]) -> Model:
    """Of the forms of the best names the one with the fewest numbers that does as well."""
    best = complete[0]
    good = [
        m
        for m in complete
        if {*m.names} == {*best.names} and rank(m)[1] <= rank(best)[1] + EQUAL_MARGIN
    ]
    return min(good, key=lambda m: sum(len(c.free) for c in m.effects))


def rank(model: Model) -> tuple[float, float]:
    """Order models: what is left above the limits, then what is left above the floors at all.

    Each block is counted in the way from its floor to its limit: where noise alone leaves now
    more and now less, a little less is no merit.
    """
    floors = model.floors
    left = (
        (model.rms[b] - floors[b].mean) / (floors[b].limit - floors[b].mean)
        for b in model.evidence.blocks
    )
    return model.misfit, sum(left)


def search_effects(
    base: Model,
    found: Sequence[Candidate],
    executor: Executor | None = None,
    progress: Progress = lambda line: None,
    width: int = SHORTLIST,
) -> EffectSearch:
    """Grow models from `base` until one is complete, or none can be."""
    levels: list[tuple[Model, ...]] = []
    if all(base.rms[b] < WORTH_ANOTHER_EFFECT * base.floors[b].limit for b in base.evidence.blocks):
        base = fit_jointly(base)  # what blocks disagree about shows in each of them little, or not
    beam = [base]
    while len(levels) < MOST_EFFECTS and not any(m.is_complete for m in beam):
        jobs = _shortlist_jobs(beam, found, max(width - 2 * len(levels), min(width, NARROWEST)))
        grown = _fit_jobs(jobs, executor)
        if not levels and not any(m.is_complete for m in grown):
            others = _list_other_jobs(base, found, jobs)
            grown = tuple(sorted((*grown, *_fit_jobs(others, executor)), key=rank))
        if not any(m.is_complete for m in grown):
            reformed = _fit_other_forms(grown[:MOST_REFORMED], found, executor)
            grown = tuple(sorted((*grown, *reformed), key=rank))
        if not grown:
            break
        levels.append(grown)
        progress(_describe_level(grown))
        beam = _keep_best_forms(grown)[: BEAM - len(levels) + 1]
    return EffectSearch(base, tuple(levels))


def _keep_best_forms(grown: Sequence[Model]) -> list[Model]:
    """Keep the best form of each set of names."""
    best: dict[frozenset[str], Model] = {}
    for model in grown:
        best.setdefault(frozenset(model.names), model)
    return [*best.values()]


def fit_to_end_if_near(model: Model) -> Model:
    """Fit a model to the end that is near its floor: a quick fit may have stopped short of it."""
    near = not model.is_complete and all(
        model.rms[b] < NEAR_LIMITS * model.floors[b].limit for b in model.evidence.blocks
    )
    return fit_to_end(model) if near else model


def confirm_complete(model: Model) -> Model:
    """Return a model that seems complete with one geometry for all blocks, fitted to the end."""
    if not model.is_complete:
        return model
    together = model.is_joint or len(model.evidence.blocks) < 2
    if together:
        return model if model.is_final else fit_to_end(model)
    return fit_jointly(model)


@dataclass(frozen=True)
class _Job:
    """A model to extend, by what, and from how many starts."""

    model: Model
    score: Score
    is_wide: bool


_Jobs = dict[frozenset[Candidate], _Job]
"""By the effects that the extended model has."""


def _shortlist_jobs(beam: Sequence[Model], found: Sequence[Candidate], width: int) -> _Jobs:
    """Return every model of the beam with each of its shortlist."""
    jobs: _Jobs = {}
    for model in beam:
        for place, score in enumerate(shortlist_candidates(model, found, width)):
            key = frozenset({*model.effects, score.candidate})
            jobs.setdefault(key, _Job(model, score, place < SEVERAL_STARTS))
    return jobs


def _list_other_jobs(base: Model, found: Sequence[Candidate], jobs: _Jobs) -> _Jobs:
    """Return the candidates that promised too little to be asked.

    Where friction holds a recalibrated model in a wrong valley, derivatives promise nothing of
    the effect that would lead out of it. A fit is no dearer than a few simulations.
    """
    others: _Jobs = {}
    for block in base.unexplained:
        for score in score_candidates(base.fit_of(block), select_reaching(found, {block}), block):
            key = frozenset({score.candidate})
            if key not in jobs:
                start = score.start or _small_dose(base, score.candidate)
                others.setdefault(key, _Job(base, replace(score, start=start), is_wide=False))
    return others


def _fit_jobs(jobs: _Jobs, executor: Executor | None) -> tuple[Model, ...]:
    """Fit the models, the most promising of them to the end; the best first."""
    grown = sorted(run_fit_jobs(_fit_job, jobs.values(), executor), key=rank)
    ended = (*map(fit_to_end_if_near, grown[:MOST_FINISHED]), *grown[MOST_FINISHED:])
    return tuple(sorted(map(confirm_complete, ended), key=rank))


def _fit_other_forms(
    models: Sequence[Model], found: Sequence[Candidate], executor: Executor | None
) -> tuple[Model, ...]:
    """Fit the last effect of each model in its other forms.

    They start where this form ended: the way there from nothing may be full of valleys, as it is
    for a steep fall of friction, and another form of it has found through.
    """
    jobs = [
        (model, form)
        for model in models
        for form in found
        if form.name == model.effects[-1].name and form != model.effects[-1]
    ]
    return tuple(map(confirm_complete, run_fit_jobs(_fit_other_form, jobs, executor)))


def _fit_other_form(job: tuple[Model, Candidate]) -> Model:
    model, form = job
    start = {**_small_dose(model, form), **model.effect_values, **dict(form.held)}
    return fit_model(model, (*model.effects[:-1], form), [start], effort=FULL)


def _fit_job(job: _Job) -> Model:
    model, score = job.model, job.score
    starts = [score.start, *(list_other_starts(model, score) if job.is_wide else ())]
    return fit_model(model, (*model.effects, score.candidate), starts)


def list_other_starts(model: Model, score: Score) -> Iterator[dict[str, float]]:
    """Start three times as far from neutral, and three times as near.

    A valley may lie beyond; and from a friction that sticks too much a fit does not find back.
    """
    for factor in (3.0, 1.0 / 3.0):
        other = dict(score.start)
        for number in score.candidate.switches:
            neutral = value_of(model.evidence.nominal, number.name)
            value = neutral + factor * (other[number.name] - neutral)
            other[number.name] = clip_inside(value, number.low, number.high, number.scale)
        yield other


def shortlist_candidates(
    model: Model, found: Sequence[Candidate], width: int = SHORTLIST
) -> list[Score]:
    """Return the most promising candidates for what a model leaves, the best first."""
    chosen: dict[Candidate, Score] = {}
    for block in model.unexplained:
        if model.effects and model.rms[block] < WORTH_ANOTHER_EFFECT * model.floors[block].limit:
            continue
        open_to = [
            c
            for c in select_reaching(found, {block})
            if c.name not in model.names and _has_room(model, c)
        ]
        for score in select_promising(score_candidates(model.fit_of(block), open_to, block), width):
            known = chosen.get(score.candidate)
            if known is None or known.explained < score.explained:
                chosen[score.candidate] = score
    if model.is_joint and not model.effects and model.unexplained:
        for candidate in _select_shared(model, found):
            chosen.setdefault(candidate, Score(candidate, 0.0, _small_dose(model, candidate)))
    return sorted(chosen.values(), key=lambda s: -s.explained)


def _select_shared(model: Model, found: Sequence[Candidate]) -> list[Candidate]:
    """Return what could make blocks disagree that are each at their floor.

    All of them: recalibration imitates them so well, each block in its own way, that to first
    order nothing is left for them to promise.
    """
    return [c for c in found if len(c.blocks & {*model.evidence.blocks}) > 1]


def _small_dose(model: Model, candidate: Candidate) -> dict[str, float]:
    settings = model.evidence.nominal
    start = next(generate_doses(candidate, settings))[0]
    return start | {
        s.name: apply_dose(s, 1.0, value_of(settings, s.name)) for s in candidate.switches
    }


def select_promising(ranked: Sequence[Score], width: int) -> list[Score]:
    """Take the first names of a ranking; of a name, every form that is near its best."""
    best: dict[str, float] = {}
    for score in ranked:
        best.setdefault(score.candidate.name, score.explained)
    hopeless = HOPELESS_SHARE * max(best.values(), default=0.0)
    names = [n for place, n in enumerate(best) if place < 3 or best[n] > hopeless][:width]
    return [
        s
        for s in ranked
        if s.candidate.name in names
        and s.explained >= max(PROMISE, best[s.candidate.name] - NEAR_FORM)
    ]


def _has_room(model: Model, candidate: Candidate) -> bool:
    return all(
        sum(block in c.blocks for c in model.effects) < MOST_EFFECTS_IN_BLOCK
        for block in candidate.blocks
    )


def run_fit_jobs(
    work: Callable[[Job], Result], jobs: Iterable[Job], executor: Executor | None
) -> list[Result]:
    """Do the jobs, in the executor's workers if there is one."""
    if executor is None:
        return [work(job) for job in jobs]
    return [future.result() for future in [executor.submit(work, job) for job in jobs]]


def _describe_level(level: Sequence[Model]) -> str:
    best = level[0]
    left = ", ".join(f"{b} {best.ratio(b):.2f}x floor" for b in best.evidence.blocks)
    return f"best with {len(best.effects)}: {' + '.join(best.names)} ({left})"
