"""The verdict: one of seven words, and the model that it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.search import EffectSearch

LEAST_CLOSED = 0.8
"""A partial explanation closes at least this share of a block's gap to the floor."""


class Verdict(StrEnum):
    """What the measurement says about the model."""

    NO_DISCREPANCY = "no_discrepancy"
    MISCALIBRATED = "miscalibrated"
    NAMED = "named"
    AMBIGUOUS = "ambiguous"
    PARTIAL = "partial"
    NONE_KNOWN = "none_known"
    BAD_DATA = "bad_data"


@dataclass(frozen=True)
class Judgement:
    """The verdict and the model it rests on."""

    verdict: Verdict
    model: Model
    explained: float
    """Share of the way from recalibrated to floor, in the worse block."""


def judge_search(search: EffectSearch, nominal: Model) -> Judgement:
    """Judge the models of a search, without regard to rivals.

    `nominal` is the start model with nothing fitted.
    """
    best = search.best
    if best is search.base and best.is_complete:
        fits = all(nominal.rms[b] <= best.floors[b].limit for b in best.evidence.blocks)
        return Judgement(Verdict.NO_DISCREPANCY if fits else Verdict.MISCALIBRATED, best, 1.0)
    if best.is_complete:
        return Judgement(Verdict.NAMED, best, 1.0)
    partial = _find_partial(search)
    if partial is None:
        return Judgement(Verdict.NONE_KNOWN, search.base, 0.0)
    return Judgement(Verdict.PARTIAL, partial, closed_share_of(search.base, partial))


def closed_share_of(base: Model, model: Model) -> float:
    """Return the share of the way to the floor that a model goes, in the worst block of `base`."""
    shares = [_closed_share_of_block(base, model, block) for block in base.unexplained]
    return min(shares, default=1.0)


def _closed_share_of_block(base: Model, model: Model, block: str) -> float:
    floor = model.floors[block].mean
    way = base.rms[block] - floor
    return float((base.rms[block] - model.rms[block]) / way) if way > 0.0 else 1.0


def _find_partial(search: EffectSearch) -> Model | None:
    """Return the model that explains most, if every effect in it is worth its place."""
    best: Model | None = None
    before = search.base
    for level in search.levels:
        worthy = [m for m in level if _is_worth_adding(before, m, search.base)]
        if not worthy:
            break
        best = before = worthy[0]
    return best


def _is_worth_adding(before: Model, model: Model, base: Model) -> bool:
    """Tell whether another effect closes most of what was left and makes no block worse."""
    if not {*before.names} <= {*model.names} or {*model.unexplained} - {*base.unexplained}:
        return False
    gained = max(
        (_closed_share_of_block(before, model, b) for b in before.unexplained), default=0.0
    )
    return gained >= LEAST_CLOSED and model.is_plausible


def revise_verdict(judgement: Judgement, standings: Sequence[Standing]) -> Verdict:
    """Make a named verdict ambiguous where a rival is no worse.

    A partial explanation with an equal rival names nothing: the remainder distorts every fit.
    """
    if not any(s.equal_rivals for s in standings):
        return judgement.verdict
    return Verdict.AMBIGUOUS if judgement.verdict is Verdict.NAMED else Verdict.NONE_KNOWN
