"""Which candidates are worth a fit, and the numbers that these fits start from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pamctl.diagnose.fitting.candidates import (
    Candidate,
    apply_dose,
    generate_doses,
    select_reaching,
)
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.naming.score import Score, clip_inside, score_candidates

SHORTLIST = 6
"""Candidates that are refitted for each unexplained block."""
HOPELESS_SHARE = 0.2
"""From the fourth on, a candidate must promise more than this share of what the first promises."""
WORTH_ANOTHER_EFFECT = 1.15
"""Another effect is tried where more than this multiple of the limit is left. Below, it would only
correct the form of an effect, or what both blocks disagree about."""
MOST_EFFECTS, MOST_IN_BLOCK = 3, 2
"""Effects of a set on a muscle, and those of one block of it: three free structures there fit
anything, since braid and geometry are free too."""
MOST_ALONE = 4
"""Effects of a tank or of a mechanism: it has few numbers beside them."""
NEAR_FORM = 0.15
"""A form of an effect is not fitted if it promises less than the best form by more than this."""
PROMISE = 0.02
"""A candidate must promise at least this share of the residual."""


def shortlist_candidates(
    model: Model, candidates: Sequence[Candidate], width: int = SHORTLIST
) -> list[Score]:
    """Return the most promising candidates for what a model leaves, the best first.

    Where blocks disagree about a number that they share, what one lacks may drive only another one
    above its limit. So all blocks are asked.
    """
    chosen: dict[Candidate, Score] = {}
    disagrees = bool(model.is_joint and not model.effects and model.unexplained)
    for block in model.evidence.blocks if disagrees else model.unexplained:
        if model.effects and model.rms[block] < WORTH_ANOTHER_EFFECT * model.floors[block].limit:
            continue
        others = [
            c
            for c in select_reaching(candidates, {block})
            if c.name not in model.names and _has_room(model, c)
        ]
        for score in select_promising(score_candidates(model.fit_of(block), others, block), width):
            known = chosen.get(score.candidate)
            if known is None or known.explained < score.explained:
                chosen[score.candidate] = score
    if disagrees:
        for candidate in _select_shared(model, candidates):
            chosen.setdefault(candidate, Score(candidate, 0.0, make_small_dose(model, candidate)))
    return sorted(chosen.values(), key=lambda s: -s.explained)


def _select_shared(model: Model, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that can make blocks disagree which are each at their floor.

    These are all that reach several blocks. Recalibration of each block imitates them so well
    that, to first order, the residual shows nothing of them.
    """
    return [c for c in candidates if len(c.blocks & {*model.evidence.blocks}) > 1]


def make_small_dose(model: Model, candidate: Candidate) -> dict[str, float]:
    """Return a start at the smallest size of interest."""
    settings = model.evidence.nominal
    start = next(generate_doses(candidate, settings))[0]
    return start | {
        s.name: apply_dose(s, 1.0, value_of(settings, s.name)) for s in candidate.switches
    }


def select_promising(ranked: Sequence[Score], width: int) -> list[Score]:
    """Take the first names of a ranking, each in every form that is near its best."""
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
    most = MOST_ALONE if stands_alone(model) else MOST_IN_BLOCK
    return all(sum(block in c.blocks for c in model.effects) < most for block in candidate.blocks)


def stands_alone(model: Model) -> bool:
    """Tell whether the rig is one block: a tank without a position, or a mechanism without air."""
    return model.evidence.nominal.actuator != "muscle"


def count_most_effects(model: Model) -> int:
    """Return how many effects a set may have."""
    return MOST_ALONE if stands_alone(model) else MOST_EFFECTS


def list_other_starts(model: Model, score: Score) -> Iterator[dict[str, float]]:
    """Yield a start three times as far from neutral, and one three times as near.

    The right valley may lie farther away; and a fit does not return from friction that sticks
    too much.
    """
    for factor in (3.0, 1.0 / 3.0):
        other = dict(score.start)
        for number in score.candidate.switches:
            neutral = value_of(model.evidence.nominal, number.name)
            value = neutral + factor * (other[number.name] - neutral)
            other[number.name] = clip_inside(value, number.low, number.high, number.scale)
        yield other


def list_returns(model: Model, score: Score) -> Iterator[dict[str, float]]:
    """Yield a start from the guesses, where a number of the plant ended at an end of its range.

    What is missing has driven it there, and with it others into a valley of their own. An effect
    that is added there does not lead out.
    """
    reached = [f for blocks, f in model.fits.items() if blocks & score.candidate.blocks]
    plant = {n.name for fitted in reached for n in fitted.free if n.effect is None}
    if any(plant & {*fitted.at_bound} for fitted in reached):
        yield {name: value_of(model.evidence.nominal, name) for name in plant} | score.start
