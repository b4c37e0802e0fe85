"""Describe what no effect of the catalogue explains: choose a term, or say leads only.

A term is said where it closes most of its block's gap on the samples that choose, does not spoil
the other block, is better than anything the catalogue offered, and beats what so many questions
find by chance. The samples that confirm decide afterwards, as for a name. Where the catalogue has
explained a part, that part and a term beside it are tried too.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import FittedNumber, estimate_intervals
from pamctl.diagnose.fitting.model_fit import fit_jointly
from pamctl.diagnose.name import Naming
from pamctl.diagnose.naming.search import closed_share
from pamctl.diagnose.naming.stretches import gains_in_block
from pamctl.diagnose.naming.verdict import Verdict, spoils_block
from pamctl.diagnose.terms.by_name import name_instead
from pamctl.diagnose.terms.trials import (
    TermTrial,
    choose_simplest,
    doubt_own_floor,
    find_terms,
    list_equals,
)
from pamctl.diagnose.terms.words import describe_term, find_kin, write_equation
from pamctl.plant.terms.operators import DRIVER_UNITS, KNOTS

LEAST_CLOSED = 0.8
"""A term that is said closes at least this share of its block's gap, where it is chosen and where
it is confirmed; beside an effect, of the gap that the effect leaves."""
MUCH_LESS = 0.8
"""What the catalogue offers counts as no worse if it leaves less than the term over this."""
MOST_LEADS = 5


@dataclass(frozen=True)
class Lead:
    """A term that may be looked at, and is no finding."""

    text: str
    location: str
    operator: str
    driver: str
    residual_over_floor: float
    explained: float
    """Share of the residual's square that it predicts, before it was fitted in the plant."""


@dataclass(frozen=True)
class CurvePoint:
    """A point of a term's curve: the driver's value, the size there, and its 90 % band."""

    at: float
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class DescribedTerm:
    """What was found: a term, in words, numbers and as a curve."""

    text: str
    location: str
    operator: str
    driver: str
    block: str
    unit: str
    driver_unit: str
    equation: str
    kin: tuple[str, ...]
    equals: tuple[str, ...]
    """Other terms, in words, that these data do not tell from it."""
    closed: float
    """Share of the block's gap that it closes, where it was chosen."""
    numbers: tuple[FittedNumber, ...] = ()
    curve: tuple[CurvePoint, ...] = ()
    name: str = ""
    """What stands before the names of its numbers, such as `force_term`."""
    equal_models: Mapping[str, Model] = field(default_factory=dict, repr=False)
    """The fitted models of `equals`, by their words."""


@dataclass(frozen=True)
class Description:
    """What was asked, and what was found."""

    asked: int
    by_chance: float
    """Share of the residual's square that the best of all questions finds in nothing."""
    leads: tuple[Lead, ...]
    term: DescribedTerm | None = None
    block: str = ""
    """The block of which most was left."""
    is_beside: bool = False
    """The term stands beside the effects that were named."""
    naming: Naming | None = field(default=None, repr=False)
    """The naming with the term, or with the effect that says it, in its model; None where neither
    is said."""


def describe_rest(
    naming: Naming,
    executor: Executor | None = None,
    progress: Callable[[str], None] = lambda line: None,
    without: Collection[str] = (),
) -> Description:
    """Describe what a naming leaves unexplained; effects in `without` take no term's place.

    A term may replace effects of its own block. What was named in another block stays.
    """
    block = max(naming.model.evidence.blocks, key=naming.model.ratio)
    progress(f"asking what no effect of the catalogue explains in the {block} block")
    own = frozenset(c.name for c in naming.model.effects if c.blocks <= {block})
    before = naming.withdraw_effects(own).model if own else naming.model
    ranking, trials = find_terms(before, block, executor)
    chosen = _choose(naming, before, trials, block)
    if chosen is None and own:
        beside_block = max(naming.model.unexplained or (block,), key=naming.model.ratio)
        beside, more = find_terms(naming.model, beside_block, executor)
        chosen = _choose(naming, naming.model, more, beside_block)
        if chosen is not None:
            before, ranking, trials, block = naming.model, beside, more, beside_block
    leads = tuple(_make_lead(t, block) for t in trials[:MOST_LEADS])
    plain = Description(ranking.asked, ranking.by_chance, leads, block=block)
    if chosen is None:
        return plain
    named = name_instead(naming, before, chosen, trials, block, without)
    if named is not None:
        return replace(plain, leads=(), naming=named)
    term, said = _say_term(naming, before, chosen, trials, block)
    return replace(plain, term=term, naming=said, is_beside=before is naming.model)


def _choose(
    naming: Naming, before: Model, trials: Sequence[TermTrial], block: str
) -> TermTrial | None:
    """Return the term that may be said; None where none is good enough."""
    if not trials:
        return None
    chosen = choose_simplest(trials)
    model = chosen.model
    if not model.is_joint and model.is_complete and len(model.evidence.blocks) > 1:
        joint = doubt_own_floor(fit_jointly(model))
        if joint.is_complete:
            chosen = replace(chosen, model=joint)
            model = joint
    share = closed_share(before, model, block)
    # Of a curve some amounts may be anything: recalibration imitates them.
    sizes = {s.name for c in model.effects for s in c.switches}
    if (
        share < LEAST_CLOSED
        or {*model.at_bound} & sizes
        or spoils_block(before, model)
        or not gains_in_block(before, model, block)
        or _is_matched_by_catalogue(naming, model, block)
    ):
        return None
    return chosen


def _is_matched_by_catalogue(naming: Naming, model: Model, block: str) -> bool:
    """Tell whether a set of effects that was fitted leaves hardly more than the term."""
    mine = model.ratio(block)
    limit = model.floors[block].limit / model.floors[block].mean
    for trial in naming.trials:
        theirs = trial.ratios[block]
        if len(trial.names) <= len(model.effects) and theirs <= max(mine / MUCH_LESS, limit):
            return True
    return False


def _make_lead(trial: TermTrial, block: str) -> Lead:
    question = trial.question
    return Lead(
        describe_term(question, trial.values),
        *question.key,
        trial.model.ratio(block),
        trial.score.explained,
    )


def _say_term(
    naming: Naming,
    before: Model,
    chosen: TermTrial,
    trials: Sequence[TermTrial],
    block: str,
) -> tuple[DescribedTerm, Naming]:
    model, question = chosen.model, chosen.question
    numbers = estimate_intervals(model)
    own = tuple(n for n in numbers if n.name.startswith(question.prefix))
    equals = {describe_term(t.question, t.values): t.model for t in list_equals(chosen, trials)}
    term = DescribedTerm(
        describe_term(question, chosen.values),
        *question.key,
        block,
        question.location.unit,
        DRIVER_UNITS[question.driver],
        write_equation(question),
        find_kin(question),
        tuple(equals),
        closed_share(before, model, block),
        own,
        _draw_curve(chosen, own),
        question.location.term_name,
        equals,
    )
    kept = {c.name for c in model.effects}
    standings = tuple(s for s in naming.standings if s.effect.name in kept)
    said = replace(
        naming, verdict=Verdict.DESCRIBED, model=model, standings=standings, numbers=numbers
    )
    return term, said


def _draw_curve(trial: TermTrial, numbers: Sequence[FittedNumber]) -> tuple[CurvePoint, ...]:
    """Return a curve's knots with their bands; empty for other operators."""
    question = trial.question
    if question.operator != "curve":
        return ()
    values, bands = trial.values, {n.name: n for n in numbers}
    size = values[question.prefix + "size"]
    low, high = question.held["low"], question.held["high"]
    points = []
    for k in range(1, KNOTS + 1):
        name = f"{question.prefix}knot_{k}"
        band = bands.get(name) or bands[question.prefix + "size"]
        times = size if name in bands else 1.0
        ends = sorted((times * band.low, times * band.high))
        at = low + (k - 1) * (high - low) / (KNOTS - 1)
        points.append(CurvePoint(at, size * values[name], ends[0], ends[1]))
    return tuple(points)


def is_confirmed(described: Description, before: float, after: float) -> bool:
    """Tell whether the samples that confirm show the share that was closed as well.

    `before` and `after` are the shares of the block's gap that are explained without the term and
    with it.
    """
    left = 1.0 - before if described.is_beside else 1.0
    gained = after - before if described.is_beside else after
    return gained >= LEAST_CLOSED * left
