"""The verdict: one of seven words, and the model that it rests on."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import hypot, sqrt

from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.naming.doubt import PIECES, is_strained, spread_of_effect
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.search import (
    EffectSearch,
    closed_share,
    keep_best_forms,
    leaves_more,
    rank,
)
from pamctl.diagnose.naming.stretches import gains_in_block

LEAST_CLOSED = 2.0 / 3.0
"""A partial explanation closes at least this share of the way from what the others leave of a block
to the block's limit. Wrong neighbours of effects in no catalogue close up to 0.6 of it."""
UNEVEN = 0.2
"""Largest spread of the size of an effect that closes everything, as a share of the size (see
`doubt`). It falls with the share that is closed: an effect that leaves much must be the same
everywhere. Wrong neighbours of effects in no catalogue reach 0.1 to 5."""
SURELY = 1.0 - 1.0 / sqrt(2.0 * (PIECES - 1))
"""A spread over so many pieces is known to this share of itself: only what is larger even then
counts against an effect."""
DISAGREES = 0.1
"""Largest share of a disagreement between the blocks that its explanation leaves. Wrong neighbours
of an effect in no catalogue left 0.17, below a limit that an encoder's counts set."""
MOST_PARTIALS = 6
"""Models of each level that are examined as partial explanations."""


class Verdict(StrEnum):
    """What the measurement says about the model."""

    NO_DISCREPANCY = "no_discrepancy"
    MISCALIBRATED = "miscalibrated"
    NAMED = "named"
    DESCRIBED = "described"
    AMBIGUOUS = "ambiguous"
    PARTIAL = "partial"
    NONE_KNOWN = "none_known"
    BAD_DATA = "bad_data"


@dataclass(frozen=True)
class Judgement:
    """The verdict and the model it rests on."""

    verdict: Verdict
    model: Model


def judge_search(search: EffectSearch, nominal: Model) -> Judgement:
    """Judge the models of a search, without regard to rivals.

    `nominal` is the start model with nothing fitted.
    """
    best = search.best
    if best is search.base and best.is_complete:
        fits = all(nominal.rms[b] <= best.floors[b].limit for b in best.evidence.blocks)
        return Judgement(Verdict.NO_DISCREPANCY if fits else Verdict.MISCALIBRATED, best)
    if best.is_complete and not leaves_disagreement(search, best):
        return Judgement(Verdict.NAMED, best)
    partial = _find_partial(search)
    return Judgement(Verdict.PARTIAL, partial) if partial else _nothing(search)


def judge_parts(search: EffectSearch, names: Collection[str]) -> Judgement:
    """Judge which part of a set of effects remains, where the whole set is not credible."""
    partial = _find_partial(search, {*names})
    return Judgement(Verdict.PARTIAL, partial) if partial else _nothing(search)


def _nothing(search: EffectSearch) -> Judgement:
    return Judgement(Verdict.NONE_KNOWN, search.base)


def _find_partial(search: EffectSearch, within: Collection[str] = ()) -> Model | None:
    """Return the model that leaves least, among those whose every effect is worth its place.

    With `within`, only parts of that set count.
    """
    levels = [[m for m in level if not within or {*m.names} < {*within}] for level in search.levels]
    worthy = [
        model
        for level in levels
        for model in keep_best_forms(level)[:MOST_PARTIALS]
        if is_worthy(model, search)
    ]
    return min(worthy, key=rank, default=None)


def is_worthy(model: Model, search: EffectSearch) -> bool:
    """Tell whether a model explains part of a block, each of its effects a good part.

    What it leaves of a block that no effect reaches does not count. Where only the numbers of the
    blocks disagree, effects explain that wholly or not at all: apart, the blocks leave less.
    """
    if leaves_disagreement(search, model):
        return False
    if spoils_block(search.base, model) or not all(map(model.is_substantial, model.effects)):
        return False
    shares = [measure_share(model, effect, search) for effect in model.effects]
    return min(shares) >= LEAST_CLOSED and all(
        SURELY * spread_of_effect(model, effect) <= UNEVEN * (2.0 * share - 1.0)
        for effect, share in zip(model.effects, shares, strict=True)
    )


def leaves_disagreement(search: EffectSearch, model: Model) -> bool:
    """Tell whether a model leaves part of what the blocks disagree by, where each alone is at its
    limit.
    """
    if search.alone is None:
        return False
    return leaves_more(model) or any(
        model.rms[block] > hypot(search.alone.rms[block], DISAGREES * search.base.rms[block])
        and gains_in_block(model, search.alone, block)
        for block in search.base.unexplained
    )


def spoils_block(base: Model, model: Model) -> bool:
    """Tell whether a model leaves really more of a block that an effect reaches, above its limit.

    Other blocks may become worse where all blocks share one geometry: the base model hides in it
    what else is missing.
    """
    reached = {block for effect in model.effects for block in effect.blocks}
    return any(
        not model.is_explained(block) and gains_in_block(model, base, block) for block in reached
    )


def measure_share(model: Model, effect: Candidate, search: EffectSearch) -> float:
    """Return how much of what the other effects leave of a block an effect really closes."""
    others = {*model.names} - {effect.name}
    known = (m for m in search.models if {*m.names} == others)
    without = min(known, key=rank, default=search.base)
    shares = [
        closed_share(without, model, block)
        for block in without.unexplained
        if block in effect.blocks and gains_in_block(without, model, block)
    ]
    return max(shares, default=0.0)


def revise_verdict(judgement: Judgement, standings: Sequence[Standing]) -> Verdict:
    """Make a verdict with names ambiguous where a rival is no worse, or where the
    effects only imitate what is missing.
    """
    imitates = judgement.verdict is Verdict.NAMED and is_strained(judgement.model)
    is_open = imitates or any(s.equal_rivals for s in standings)
    return Verdict.AMBIGUOUS if is_open else judgement.verdict
