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
from pamctl.diagnose.fitting.candidates import Candidate, dosed, reaching, trials
from pamctl.diagnose.fitting.fitted_model import Model, extended, joined, polished
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.naming.score import Score, inside, scores

SHORTLIST = 6
"""Candidates refitted for each unexplained block, and as many again that reach both."""
NARROWEST = 4
"""Of later levels, which grow from fewer models: a spool promises less than a delay at first."""
BEAM = 3
"""Models of a level that the next one grows from."""
NEAR = 4.0
"""A quick fit within so many limits is driven on."""
FINISHED = 3
"""So many of a level, at most."""
AS_WELL = 0.1
"""A simpler form does as well that leaves so little more, counted from the floor to its limit."""
HOPELESS = 0.2
"""Beyond the third a candidate must promise so much of what the first one does."""
WORTH = 1.15
"""Another effect is asked for where so many limits are left: below, it would mend a form, or
what both blocks disagree about."""
REFORMED = 2
"""So many models of a level are tried in other forms of their last effect."""
SEVERAL_STARTS = 2
"""So many of a shortlist are fitted from several starts."""
MOST = 3
MOST_IN_BLOCK = 2
"""Three free structures in one block fit anything."""
NEAR_FORM = 0.15
"""A form of an effect that promises less than its best one by more is not fitted."""
PROMISE = 0.02
"""Share of the residual that a candidate must promise."""

Progress = Callable[[str], None]
Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Search:
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
            return _simplest(self.complete)
        return self.nearest

    @property
    def nearest(self) -> Model:
        """The best fit, whatever numbers it needs; of those that leave nothing, if any do."""
        if self.complete:
            return self.complete[0]
        return min((self.base, *(m for level in self.levels for m in level)), key=rank)

    def widened(self, heard: Iterable[Model]) -> Search:
        """Return the search with more models, each among those of as many effects."""
        levels = [[*level] for level in self.levels]
        for model in heard:
            level = levels[len(model.effects) - 1]
            if all({*model.effects} != {*known.effects} for known in level):
                level.append(model)
        return Search(self.base, tuple(tuple(sorted(level, key=rank)) for level in levels))


def _simplest(complete: Sequence[Model]) -> Model:
    """Of the forms of the best names the one with the fewest numbers that does as well."""
    best = complete[0]
    good = [
        m for m in complete if {*m.names} == {*best.names} and rank(m)[1] <= rank(best)[1] + AS_WELL
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


def searched(
    base: Model,
    found: Sequence[Candidate],
    executor: Executor | None = None,
    progress: Progress = lambda line: None,
    width: int = SHORTLIST,
) -> Search:
    """Grow models from `base` until one is complete, or none can be."""
    levels: list[tuple[Model, ...]] = []
    if all(base.rms[b] < WORTH * base.floors[b].limit for b in base.evidence.blocks):
        base = joined(base)  # what blocks disagree about shows in each of them little, or not
    beam = [base]
    while len(levels) < MOST and not any(m.is_complete for m in beam):
        jobs = _shortlisted(beam, found, max(width - 2 * len(levels), min(width, NARROWEST)))
        grown = _grown_to_the_end(jobs, executor)
        if not levels and not any(m.is_complete for m in grown):
            others = _all_others(base, found, jobs)
            grown = tuple(sorted((*grown, *_grown_to_the_end(others, executor)), key=rank))
        if not any(m.is_complete for m in grown):
            reformed = _in_other_forms(grown[:REFORMED], found, executor)
            grown = tuple(sorted((*grown, *reformed), key=rank))
        if not grown:
            break
        levels.append(grown)
        progress(_told(grown))
        beam = _best_of_each(grown)[: BEAM - len(levels) + 1]
    return Search(base, tuple(levels))


def _best_of_each(grown: Sequence[Model]) -> list[Model]:
    """Keep the best form of each set of names."""
    best: dict[frozenset[str], Model] = {}
    for model in grown:
        best.setdefault(frozenset(model.names), model)
    return [*best.values()]


def finished(model: Model) -> Model:
    """Fit a model to the end that is near its floor: a quick fit may have stopped short of it."""
    near = not model.is_complete and all(
        model.rms[b] < NEAR * model.floors[b].limit for b in model.evidence.blocks
    )
    return polished(model) if near else model


def proven(model: Model) -> Model:
    """Return a model that seems complete with one geometry for all blocks, fitted to the end."""
    if not model.is_complete:
        return model
    together = model.is_joint or len(model.evidence.blocks) < 2
    if together:
        return model if model.is_final else polished(model)
    return joined(model)


@dataclass(frozen=True)
class _Job:
    """A model to extend, by what, and from how many starts."""

    model: Model
    score: Score
    is_wide: bool


_Jobs = dict[frozenset[Candidate], _Job]
"""By the effects that the extended model has."""


def _shortlisted(beam: Sequence[Model], found: Sequence[Candidate], width: int) -> _Jobs:
    """Return every model of the beam with each of its shortlist."""
    jobs: _Jobs = {}
    for model in beam:
        for place, score in enumerate(shortlist(model, found, width)):
            key = frozenset({*model.effects, score.candidate})
            jobs.setdefault(key, _Job(model, score, place < SEVERAL_STARTS))
    return jobs


def _all_others(base: Model, found: Sequence[Candidate], jobs: _Jobs) -> _Jobs:
    """Return the candidates that promised too little to be asked.

    Where friction holds a recalibrated model in a wrong valley, derivatives promise nothing of
    the effect that would lead out of it. A fit is no dearer than a few simulations.
    """
    others: _Jobs = {}
    for block in base.unexplained:
        for score in scores(base.fit_of(block), reaching(found, {block}), block):
            key = frozenset({score.candidate})
            if key not in jobs:
                start = score.start or _small_dose(base, score.candidate)
                others.setdefault(key, _Job(base, replace(score, start=start), is_wide=False))
    return others


def _grown_to_the_end(jobs: _Jobs, executor: Executor | None) -> tuple[Model, ...]:
    """Fit the models, the most promising of them to the end; the best first."""
    grown = sorted(mapped(_grown, jobs.values(), executor), key=rank)
    ended = (*map(finished, grown[:FINISHED]), *grown[FINISHED:])
    return tuple(sorted(map(proven, ended), key=rank))


def _in_other_forms(
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
    return tuple(map(proven, mapped(_reformed, jobs, executor)))


def _reformed(job: tuple[Model, Candidate]) -> Model:
    model, form = job
    start = {**_small_dose(model, form), **model.effect_values, **dict(form.held)}
    return extended(model, (*model.effects[:-1], form), [start], effort=FULL)


def _grown(job: _Job) -> Model:
    model, score = job.model, job.score
    starts = [score.start, *(other_starts(model, score) if job.is_wide else ())]
    return extended(model, (*model.effects, score.candidate), starts)


def other_starts(model: Model, score: Score) -> Iterator[dict[str, float]]:
    """Start three times as far from neutral, and three times as near.

    A valley may lie beyond; and from a friction that sticks too much a fit does not find back.
    """
    for factor in (3.0, 1.0 / 3.0):
        other = dict(score.start)
        for number in score.candidate.switches:
            neutral = value_of(model.evidence.nominal, number.name)
            value = neutral + factor * (other[number.name] - neutral)
            other[number.name] = inside(value, number.low, number.high, number.scale)
        yield other


def shortlist(model: Model, found: Sequence[Candidate], width: int = SHORTLIST) -> list[Score]:
    """Return the most promising candidates for what a model leaves, the best first."""
    chosen: dict[Candidate, Score] = {}
    for block in model.unexplained:
        if model.effects and model.rms[block] < WORTH * model.floors[block].limit:
            continue
        open_to = [
            c for c in reaching(found, {block}) if c.name not in model.names and _has_room(model, c)
        ]
        for score in promising(scores(model.fit_of(block), open_to, block), width):
            known = chosen.get(score.candidate)
            if known is None or known.explained < score.explained:
                chosen[score.candidate] = score
    if model.is_joint and not model.effects and model.unexplained:
        for candidate in _of_both_blocks(model, found):
            chosen.setdefault(candidate, Score(candidate, 0.0, _small_dose(model, candidate)))
    return sorted(chosen.values(), key=lambda s: -s.explained)


def _of_both_blocks(model: Model, found: Sequence[Candidate]) -> list[Candidate]:
    """Return what could make blocks disagree that are each at their floor.

    All of them: recalibration imitates them so well, each block in its own way, that to first
    order nothing is left for them to promise.
    """
    return [c for c in found if len(c.blocks & {*model.evidence.blocks}) > 1]


def _small_dose(model: Model, candidate: Candidate) -> dict[str, float]:
    settings = model.evidence.nominal
    start = next(trials(candidate, settings))[0]
    return start | {s.name: dosed(s, 1.0, value_of(settings, s.name)) for s in candidate.switches}


def promising(ranked: Sequence[Score], width: int) -> list[Score]:
    """Take the first names of a ranking; of a name, every form that is near its best."""
    best: dict[str, float] = {}
    for score in ranked:
        best.setdefault(score.candidate.name, score.explained)
    hopeless = HOPELESS * max(best.values(), default=0.0)
    names = [n for place, n in enumerate(best) if place < 3 or best[n] > hopeless][:width]
    return [
        s
        for s in ranked
        if s.candidate.name in names
        and s.explained >= max(PROMISE, best[s.candidate.name] - NEAR_FORM)
    ]


def _has_room(model: Model, candidate: Candidate) -> bool:
    return all(
        sum(block in c.blocks for c in model.effects) < MOST_IN_BLOCK for block in candidate.blocks
    )


def mapped(
    work: Callable[[Job], Result], jobs: Iterable[Job], executor: Executor | None
) -> list[Result]:
    """Do the jobs, in the executor's workers if there is one."""
    if executor is None:
        return [work(job) for job in jobs]
    return [future.result() for future in [executor.submit(work, job) for job in jobs]]


def _told(level: Sequence[Model]) -> str:
    best = level[0]
    left = ", ".join(f"{b} {best.ratio(b):.2f}x floor" for b in best.evidence.blocks)
    return f"best with {len(best.effects)}: {' + '.join(best.names)} ({left})"
