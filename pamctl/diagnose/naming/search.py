"""Search the smallest set of effects that brings every block to its floor.

The score test makes a shortlist; its candidates are refitted and judged on the held-out records.
A set of effects is complete when nothing is left above the floor's limit. If no single effect of
the shortlist is complete, all other effects are fitted too. Sets grow by one effect at a time
from the best few of the level before, as long as effects gain something.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TypeVar

from pamctl.diagnose.fitting.block_fit import FULL
from pamctl.diagnose.fitting.candidates import Candidate, select_reaching
from pamctl.diagnose.fitting.far_starts import fit_from_windows
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import fit_jointly, fit_model, fit_to_end
from pamctl.diagnose.naming.pairs import fit_pairs
from pamctl.diagnose.naming.score import Score, score_candidates
from pamctl.diagnose.naming.shortlist import (
    SHORTLIST,
    WORTH_ANOTHER_EFFECT,
    count_most_effects,
    list_other_starts,
    list_returns,
    make_small_dose,
    shortlist_candidates,
    stands_alone,
)
from pamctl.diagnose.naming.stretches import gains_in_block

NARROWEST = 4
"""Shortlist of later levels, which grow from fewer models. It must not be shorter: a spool promises
less than a delay at first."""
BEAM = (2, 1, 1)
"""Models with one effect, with two, and with three, from which the next level grows."""
NEAR_LIMITS = 4.0
"""A quick fit that leaves less than this multiple of the limit is fitted to the end."""
HOPELESS_LIMITS = 10.0
"""A fit that leaves more than this multiple of a limit, where another leaves only noise, is not
tried from other starts."""
MOST_FINISHED = 3
"""At most this many models of a level are fitted to the end."""
EQUAL_MARGIN = 0.1
"""A simpler form counts as equally good if it leaves at most this much more. The unit is the way
from the floor to its limit."""
MOST_REFORMED = 2
"""Models of a level whose last effect is tried in its other forms."""
WORTH_ANOTHER_FORM = 0.5
"""An effect that goes a smaller share of a block's way to its limit lacks more than its form."""
SEVERAL_STARTS = (2, 1)
"""Candidates of a shortlist that are fitted from several starts: as first effects, and as further
ones."""
STUCK_LIMITS = 3.0
"""Pairs are asked where a model leaves more than this multiple of a block's limit, and no further
effect takes it far."""
SILENT_S = 5.0
"""Longest time without a line of progress, if fits end in it."""
GROWS_FROM = (0.05, 0.5, 0.5)
"""Sets grow from one effect, and from more, that go this share of a block's way to its limit. Two
effects can each look poor alone; three free structures that leave half explain nothing."""
NEAR_BEST = 1.0 / 3.0
"""Sets do not grow from a model that gains less than this share of what the best one gains; nor,
where a model explains a block, from others that explain only a part of it."""

Progress = Callable[[str], None]
"""Receives one line about each step."""
Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class EffectsTrial:
    """One set of effects that was fitted."""

    names: tuple[str, ...]
    ratios: Mapping[str, float]
    """Held-out RMS over the floor, by block."""


@dataclass(frozen=True)
class EffectSearch:
    """Every model that was fitted, by number of effects; the best first within each level."""

    base: Model
    levels: tuple[tuple[Model, ...], ...]
    alone: Model | None = None
    """Each block with numbers of its own, where that leaves nothing above the limits and the base,
    which has the same numbers for both, does."""

    @property
    def complete(self) -> tuple[Model, ...]:
        """Models that leave nothing above the limits, with the fewest effects that can."""
        for level in ((self.base,), *self.levels):
            done = tuple(m for m in level if m.is_complete)
            if done:
                return done
        return ()

    @property
    def best(self) -> Model:
        """The model that leaves least; among complete models, the simplest good one."""
        if self.complete:
            return _choose_simplest(self.complete)
        return self.nearest

    @property
    def nearest(self) -> Model:
        """The best fit, however many numbers it has; among complete models, if there are any."""
        if self.complete:
            return self.complete[0]
        return min((self.base, *self.models), key=rank)

    @property
    def models(self) -> tuple[Model, ...]:
        """All models that have effects."""
        return tuple(model for level in self.levels for model in level)

    def list_trials(self) -> tuple[EffectsTrial, ...]:
        """Return what every set of effects leaves, the best first."""
        return tuple(
            EffectsTrial(m.names, {b: m.ratio(b) for b in m.evidence.blocks})
            for m in sorted(self.models, key=rank)
        )

    def add_models(self, models: Iterable[Model]) -> EffectSearch:
        """Return the search with more models, each in the level of its number of effects."""
        levels = [[*level] for level in self.levels]
        for model in models:
            level = levels[len(model.effects) - 1]
            if all({*model.effects} != {*known.effects} for known in level):
                level.append(model)
        return replace(self, levels=tuple(tuple(sorted(level, key=rank)) for level in levels))


def _choose_simplest(complete: Sequence[Model]) -> Model:
    """Choose among the forms of the best names: as good as the best, with the fewest numbers."""
    best = complete[0]
    good = [m for m in complete if {*m.names} == {*best.names} and _is_as_good(m, best)]
    return min(good, key=lambda m: sum(len(c.free) for c in m.effects))


def _is_as_good(model: Model, best: Model) -> bool:
    return model.is_complete and rank(model)[1] <= rank(best)[1] + EQUAL_MARGIN


def rank(model: Model) -> tuple[float, float]:
    """Return a key that orders models: what is left above the limits, then above the floors.

    The unit of each block is the way from its floor to its limit: a difference that noise alone
    makes does not count.
    """
    floors = model.floors
    left = (
        (model.rms[b] - floors[b].mean) / (floors[b].limit - floors[b].mean)
        for b in model.evidence.blocks
    )
    return model.misfit, sum(left)


def search_effects(
    base: Model,
    candidates: Sequence[Candidate],
    executor: Executor | None = None,
    progress: Progress = lambda line: None,
    width: int = SHORTLIST,
    known: Iterable[Model] = (),
) -> EffectSearch:
    """Grow models from `base` until one is complete, or none can be.

    `known` are models of some of the blocks, fitted earlier to the same drives.
    """
    levels: list[tuple[Model, ...]] = []
    apart, base = base, base if leaves_more(base) else fit_jointly(base)
    # A disagreement between the blocks hardly shows in either alone.
    alone = apart if base is not apart and leaves_more(base) else None
    # Of two fits of the same effects the better one comes first, and stays.
    best_first = () if base.is_joint else [*known]
    known_by_effects = {frozenset(m.effects): m for m in reversed(best_first)}
    fitter = _Fitter(executor, known_by_effects, progress)
    beam = [base]
    size = count_most_effects(base)
    while len(levels) < size and beam and not any(m.is_complete for m in beam):
        jobs = _shortlist_jobs(
            beam, candidates, max(width - 2 * len(levels), min(width, NARROWEST))
        )
        grown = fitter.fit_jobs(jobs)
        if not levels and not any(m.is_complete for m in grown):
            others = _list_other_jobs(base, candidates, jobs, grown)
            grown = tuple(sorted((*grown, *fitter.fit_jobs(others, grown)), key=rank))
        if not any(m.is_complete for m in grown):
            most = [m for m in grown[:MOST_REFORMED] if _goes_far(base, m)]
            freed = fitter.fit_from_windows(most)
            reformed = fitter.fit_other_forms(freed, candidates)
            better = [new for new, old in zip(freed, most, strict=True) if new is not old]
            grown = tuple(sorted((*grown, *better, *reformed), key=rank))
        if not grown:
            break
        if grown[0].is_complete:
            grown = simplify_first(grown, candidates, executor)
        levels.append(grown)
        progress(_describe_level(grown))
        pairs = _fit_pairs(beam[0], grown, candidates) if len(levels) < size else ()
        if pairs:
            levels.append(pairs)
            progress(_describe_level(pairs))
        beam = choose_beam(base, levels)
    return EffectSearch(base, tuple(levels), alone)


def leaves_more(model: Model) -> bool:
    """Tell whether a model leaves enough of a block for another effect."""
    return any(
        model.rms[b] >= WORTH_ANOTHER_EFFECT * model.floors[b].limit for b in model.evidence.blocks
    )


def choose_beam(base: Model, levels: Sequence[Sequence[Model]]) -> list[Model]:
    """Return the models of the last level from which the next one grows, the best first."""
    grown = keep_best_forms(levels[-1])
    if len(levels) == count_most_effects(base) or any(m.is_complete for m in grown):
        return grown[:1]
    worth: set[int] = set()
    for block in base.unexplained:
        shares = [closed_share(base, model, block) for model in grown]
        most = max(shares)
        needed = most if most == 1.0 else NEAR_BEST * most
        least = max(needed, GROWS_FROM[len(levels) - 1])
        worth |= {
            place
            for place, model in enumerate(grown)
            if shares[place] >= least and gains_in_block(base, model, block)
        }
    return [grown[place] for place in sorted(worth)][: BEAM[len(levels) - 1]]


def _fit_pairs(
    parent: Model, grown: Sequence[Model], candidates: Sequence[Candidate]
) -> tuple[Model, ...]:
    """Fit two effects more at once where no single one goes far; return those that do.

    On a muscle they were never the right ones in a study of rigs, and cost as much as all others.
    """
    if not stands_alone(parent):
        return ()
    far = [
        block
        for block in parent.unexplained
        if parent.rms[block] > STUCK_LIMITS * parent.floors[block].limit
        and not any(closed_share(parent, m, block) >= WORTH_ANOTHER_FORM for m in grown)
    ]
    fitted = [m for block in far for m in fit_pairs(parent, candidates, block)]
    ended = [confirm_complete(fit_to_end_if_near(m)) for m in fitted if _goes_far(parent, m)]
    return tuple(sorted(ended, key=rank))


def _goes_far(base: Model, model: Model) -> bool:
    shares = (closed_share(base, model, block) for block in base.unexplained)
    return any(share >= WORTH_ANOTHER_FORM for share in shares)


def closed_share(before: Model, model: Model, block: str) -> float:
    """Return the share of the way from one model's RMS to the limit that another goes.

    What lies below the limit is noise, or what the rig does differently each time: nothing can
    explain it.
    """
    way = before.rms[block] - model.floors[block].limit
    gained = before.rms[block] - model.rms[block]
    return min(float(gained / way), 1.0) if way > 0.0 else 0.0


def keep_best_forms(grown: Iterable[Model]) -> list[Model]:
    """Keep the best form of each set of names."""
    best: dict[frozenset[str], Model] = {}
    for model in grown:
        best.setdefault(frozenset(model.names), model)
    return [*best.values()]


def fit_to_end_if_near(model: Model) -> Model:
    """Fit a model near its floor to the end: a quick fit may have stopped before the floor."""
    is_open = not (model.is_final or model.is_complete)
    near = is_open and all(
        model.rms[b] < NEAR_LIMITS * model.floors[b].limit for b in model.evidence.blocks
    )
    return fit_to_end(model) if near else model


def simplify_first(
    grown: Sequence[Model], candidates: Sequence[Candidate], executor: Executor | None = None
) -> tuple[Model, ...]:
    """Put a simpler form in the first model's place where its richer form says no more.

    That is asked where a shape of an effect ended at an end of its range: two tanks of which one
    is empty are one tank, and were needed only before the next effect came.
    """
    first = grown[0]
    ended = {name for fitted in first.fits.values() for name in fitted.at_bound}
    tried = {frozenset(m.effects) for m in grown}
    swapped = [
        (first, tuple(form if e is effect else e for e in first.effects))
        for effect in first.effects
        if ended & {shape.name for shape in effect.shapes}
        for form in _list_other_forms(effect, candidates)
        if len(form.free) < len(effect.free)
    ]
    jobs = [job for job in swapped if frozenset(job[1]) not in tried]
    simpler = [confirm_complete(m) for m in run_fit_jobs(_fit_form, jobs, executor)]
    kept = grown[1:] if any(_is_as_good(m, first) for m in simpler) else grown
    return tuple(sorted((*kept, *simpler), key=rank))


def confirm_complete(model: Model) -> Model:
    """Refit a model that seems complete, to the end and with one geometry for all blocks."""
    if not model.is_complete:
        return model
    together = model.is_joint or len(model.evidence.blocks) < 2
    if together:
        return model if model.is_final else fit_to_end(model)
    return fit_jointly(model)


@dataclass(frozen=True)
class _Job:
    """A model to extend, the candidate to extend it by, and whether several starts are tried."""

    model: Model
    score: Score
    is_wide: bool


_Jobs = dict[frozenset[Candidate], _Job]
"""Jobs by the effects that the extended model has."""
_FormJob = tuple[Model, tuple[Candidate, ...]]
"""A model, and its effects with one of them in another form."""


def _shortlist_jobs(beam: Sequence[Model], candidates: Sequence[Candidate], width: int) -> _Jobs:
    """Return jobs that extend every model of the beam by each candidate of its shortlist."""
    jobs: _Jobs = {}
    for model in beam:
        scores = shortlist_candidates(model, candidates, width)
        several = SEVERAL_STARTS[0]
        if model.effects:  # one form of each; the best sets are tried in the other forms later
            best: dict[str, Score] = {}
            for score in scores:
                best.setdefault(score.candidate.name, score)
            scores, several = [*best.values()], SEVERAL_STARTS[1]
        for place, score in enumerate(scores):
            key = frozenset({*model.effects, score.candidate})
            jobs.setdefault(key, _Job(model, score, place < several))
    return jobs


def _list_other_jobs(
    base: Model, candidates: Sequence[Candidate], jobs: _Jobs, grown: Sequence[Model]
) -> _Jobs:
    """Return jobs for the candidates that promised too little for the shortlist.

    Friction may hold a recalibrated model in a wrong valley. Derivatives then promise nothing of
    the effect that leads out of it. Of a block that a model of the shortlist (`grown`) explains,
    only those are asked that may explain another block too.
    """
    others: _Jobs = {}
    left = {*base.unexplained}
    opened = {b for b in left if not any(m.is_explained(b) and m.is_plausible for m in grown)}
    for block in base.unexplained:
        for score in score_candidates(
            base.fit_of(block), select_reaching(candidates, {block}), block
        ):
            key = frozenset({score.candidate})
            reached = score.candidate.blocks & left
            if key not in jobs and (reached & opened or len(reached) > 1):
                start = score.start or make_small_dose(base, score.candidate)
                others.setdefault(key, _Job(base, replace(score, start=start), is_wide=False))
    return others


@dataclass(frozen=True)
class _Fitter:
    """Fits jobs, in the executor's workers if there is one."""

    executor: Executor | None
    known: Mapping[frozenset[Candidate], Model]
    """Models of some of the blocks, by their effects: these are not fitted again."""
    progress: Progress = lambda line: None

    def fit_jobs(self, jobs: _Jobs, beside: Sequence[Model] = ()) -> tuple[Model, ...]:
        """Fit the models, the most promising ones to the end; return the best first.

        `beside` are models of the same level that were fitted before.
        """
        found = [m for effects, job in jobs.items() if (m := self._look_up(effects, job.model))]
        done = {frozenset(m.effects) for m in found}
        rest = [job for effects, job in jobs.items() if effects not in done]
        grown = sorted((*found, *self._fit(rest)), key=rank)
        nearest = {id(m) for m in sorted((*grown, *beside), key=rank)[:MOST_FINISHED]}
        ended = (fit_to_end_if_near(m) if id(m) in nearest else m for m in grown)
        return tuple(sorted(map(confirm_complete, ended), key=rank))

    def _fit(self, jobs: Sequence[_Job]) -> list[Model]:
        """Fit the jobs from their first starts, then from others where that may lead further.

        Beside a model that leaves no more than noise, only those that are near it may.
        """
        grown = run_fit_jobs(_fit_first_start, jobs, self.executor, self.progress)
        is_done = any(not m.unexplained for m in grown)
        again = [
            (place, job, model)
            for place, (job, model) in enumerate(zip(jobs, grown, strict=True))
            if job.is_wide and model.unexplained and not (is_done and _is_far(model))
        ]
        tried = run_fit_jobs(_fit_other_starts, [(j, m) for _, j, m in again], self.executor)
        for (place, _, _), better in zip(again, tried, strict=True):
            grown[place] = better
        return grown

    def fit_from_windows(self, models: Sequence[Model]) -> tuple[Model, ...]:
        """Return the models, each freed from the valley where friction may hold its fit."""
        return tuple(map(confirm_complete, run_fit_jobs(fit_from_windows, models, self.executor)))

    def fit_other_forms(
        self, models: Sequence[Model], candidates: Sequence[Candidate]
    ) -> tuple[Model, ...]:
        """Fit the last effect of each model in its other forms.

        They start where this form ended. From neutral values the way may be full of valleys, as it
        is for friction that falls steeply with speed.
        """
        jobs = [
            (model, (*model.effects[:-1], form))
            for model in models
            for form in _list_other_forms(model.effects[-1], candidates)
        ]
        known = [self._look_up(frozenset(effects), model) for model, effects in jobs]
        new = [job for job, found in zip(jobs, known, strict=True) if found is None]
        fitted = iter(run_fit_jobs(_fit_form, new, self.executor))
        return tuple(confirm_complete(found or next(fitted)) for found in known)

    def _look_up(self, effects: frozenset[Candidate], whole: Model) -> Model | None:
        """Return a known model with these effects, with the other blocks as in another."""
        part = self.known.get(effects)
        if part is None or whole.is_joint:
            return None
        reached = {b for c in effects for b in c.blocks}
        if reached - {*part.evidence.blocks}:
            return None
        taken = {blocks: fit for blocks, fit in part.fits.items() if blocks & reached}
        others = {
            blocks: fit
            for blocks, fit in whole.fits.items()
            if not any(blocks & shared for shared in taken)
        }
        return Model(whole.evidence, part.effects, {**others, **taken}, part.is_joint,
                     whole.root or whole, is_final=part.is_final)  # fmt: skip


def _list_other_forms(effect: Candidate, candidates: Sequence[Candidate]) -> Iterator[Candidate]:
    return (form for form in candidates if form.name == effect.name and form != effect)


def _fit_form(job: _FormJob) -> Model:
    """Fit a model's effects, one of them in another form, from where this one ended."""
    model, effects = job
    (form,) = {*effects} - {*model.effects}
    start = {**make_small_dose(model, form), **model.effect_values, **dict(form.held)}
    return fit_model(model, effects, [start], effort=FULL)


def _fit_first_start(job: _Job) -> Model:
    starts = [job.score.start, *list_returns(job.model, job.score)]
    return fit_model(job.model, (*job.model.effects, job.score.candidate), starts)


def _fit_other_starts(given: tuple[_Job, Model]) -> Model:
    """Return the model, or the better one from another start."""
    job, first = given
    starts = [*list_other_starts(job.model, job.score)]
    other = fit_model(job.model, first.effects, starts)
    return min(first, other, key=_sum_squares)


def _sum_squares(model: Model) -> float:
    return sum(float(fitted.residual @ fitted.residual) for fitted in model.fits.values())


def _is_far(model: Model) -> bool:
    """Tell whether a fit has ended far above the limit of a block."""
    return any(model.rms[b] > HOPELESS_LIMITS * model.floors[b].limit for b in model.unexplained)


def run_fit_jobs(
    work: Callable[[Job], Result],
    jobs: Iterable[Job],
    executor: Executor | None,
    progress: Progress = lambda line: None,
) -> list[Result]:
    """Run the jobs, in the executor's workers if there is one; say how long they still take."""
    waiting = [*jobs]
    if executor is None:
        results = (work(job) for job in waiting)
    else:
        results = (f.result() for f in [executor.submit(work, job) for job in waiting])
    done: list[Result] = []
    began_s = said_s = perf_counter()
    for result in results:
        done.append(result)
        now_s = perf_counter()
        if now_s - said_s > SILENT_S and len(done) < len(waiting):
            left_s = (now_s - began_s) / len(done) * (len(waiting) - len(done))
            progress(f"{len(done)} of {len(waiting)} sets fitted, about {left_s:.0f} s left")
            said_s = now_s
    return done


def _describe_level(level: Sequence[Model]) -> str:
    best = level[0]
    ratios = ", ".join(f"{b} {best.ratio(b):.2f} x floor" for b in best.evidence.blocks)
    count = "1 effect" if len(best.effects) == 1 else f"{len(best.effects)} effects"
    return f"best with {count}: {' and '.join(best.names)} ({ratios})"
