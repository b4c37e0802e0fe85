"""The ladder: place, kind and name of each finding, each said where all outside are beaten.

It is no chain. A name's rivals stand in its stead beside the rest of the model, fitted, under the
resolution of the model without it. A freer term of the same place can always mimic a name: it
speaks against it only where it clearly does better.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.evidence.constants import (
    FREER_SHARE,
    LEFT_SHARE,
    NAME_NATS,
    NAME_SHARE,
    RIVAL_SHARE,
    SURE,
)
from pamctl.diagnose.evidence.fit import KEPT_PROMISE, Array, WeighedModel, Weigher, bound_gain
from pamctl.diagnose.evidence.measuring_chain import HOME
from pamctl.diagnose.evidence.name_search import NameSearch, list_at_range
from pamctl.diagnose.evidence.pool import CHAIN, Hypothesis
from pamctl.diagnose.evidence.scores import EvidenceScore
from pamctl.diagnose.plant_numbers import FittedNumber, unit_of

Intervals = Mapping[str, tuple[float, float]]
RIVALS = 4
"""Names that are fitted in its stead, and half as many free terms, beside the best of another kind
and of another place."""


@dataclass(frozen=True)
class JudgedRival:
    """A rival that was fitted in the stead of a finding, and by how much it is behind."""

    hypothesis: Hypothesis
    behind_nats: float
    interval_nats: tuple[float, float]
    loses: float
    """Share of the bootstrap's draws in which it is behind."""
    is_beaten: bool
    is_freer: bool
    """A law without a name of the same place, which can always mimic a name."""


@dataclass(frozen=True)
class Finding:
    """One thing that the model lacks, and how far up it may be said."""

    hypothesis: Hypothesis
    says_place: bool
    says_kind: bool
    says_name: bool
    gain_nats: float
    interval_nats: tuple[float, float]
    share: float
    """Of the gain of the whole model."""
    numbers: tuple[FittedNumber, ...]
    at_range: tuple[str, ...]
    """Numbers that stand at their range: then no name is said."""
    is_rest: bool
    """Whether it is small beside what was found before it: it mends the model, and is no cause."""
    judged: tuple[JudgedRival, ...]
    """All rivals that were fitted, the nearest first."""

    @property
    def rivals(self) -> tuple[Hypothesis, ...]:
        """Return what is not beaten, the nearest first."""
        return tuple(j.hypothesis for j in self.judged if not j.is_beaten)

    @property
    def name(self) -> str:
        """The effect, fault or law that does best."""
        return self.hypothesis.name

    @property
    def level(self) -> str:
        """The rung that is reached: name, kind, place, or set; `rest` of what is only mended."""
        if self.is_rest:
            return "rest"
        if self.says_place and self.says_kind:
            return "name" if self.says_name else "kind"
        return "place" if self.says_place else "set"


def climb_ladder(search: NameSearch, base: WeighedModel, m: WeighedModel) -> list[Finding]:
    """Return what may be said of each name of a model, in the order in which they were found."""
    intervals = search.weigher.find_intervals(m)
    search.weigher.meet(base, m)
    whole = max(base.total - m.total, 1e-9)
    return [_find_level(search, base, m, name, intervals, whole) for name in m.names]


def _find_level(
    search: NameSearch, base: WeighedModel, m: WeighedModel, name: str, intervals: Intervals,
    whole: float,
) -> Finding:  # fmt: skip
    weigher, pool, mine = search.weigher, search.pool, search.pool[name]
    without, is_first = search.drop(m, name), name == m.names[0]
    own = without.left_out - m.left_out
    low, _, high = bound_gain(own)
    gained = float(own.sum()), (float(low), float(high)), float(own.sum()) / whole
    numbers, at_range = _list_numbers(m, name, intervals), list_at_range(m, name)
    if not is_first and own.sum() < NAME_SHARE * whole:  # nobody asks for its rivals
        return Finding(mine, False, False, False, *gained, numbers, at_range, True, ())
    asked = [n for n in pool if n != name and _may_rival(search, n, mine)]
    scored = _choose_rivals(search, search.score(without, asked), mine)
    promised = {s.name: s.gain for s in scored}
    rivals = search.refit(without, scored, len(scored), float(own.sum())) if scored else []
    weigher.meet(without, m)
    close = m.total + RIVAL_SHARE * own.sum()
    for rival in rivals:
        if weigher.leave_out(rival).total < close:
            weigher.settle(rival, 4)  # as the model was: on a ridge a fit goes on for long
    weigher.meet(without, m)
    says_place = says_kind = True
    # Where a law without a name is missing too, what is a name there may be a part of it.
    says_name = not mine.is_term and not any(
        pool[n].laws & mine.laws for n in m.names if pool[n].is_term
    )
    judged = list[JudgedRival]()
    for rival in rivals:
        weigher.leave_out(rival)
        its, lead = pool[rival.names[-1]], rival.left_out - m.left_out
        least = bound_gain(lead)[0]
        extra = len(rival.x) - len(m.x)
        beaten = (
            least > RIVAL_SHARE * own.sum()
            or (least > NAME_NATS and takes_enough(weigher, rival, m))
            or (extra > 0 and lead.sum() > -extra)  # it gains nothing for its further numbers
        )
        if (
            its.place == mine.place
            and rival.total > without.total - KEPT_PROMISE * promised[its.name]
        ):
            beaten &= promised[its.name] < LEFT_SHARE * own.sum()  # its fit failed: it may be true
        is_freer = its.is_term and (its.place == mine.place or its.name in mine.akin)
        judged.append(_judge_rival(its, lead, beaten=bool(beaten), is_freer=is_freer))
        if is_freer:
            if bound_gain(-lead)[0] > FREER_SHARE * own.sum():
                says_name = False
                says_kind &= its.kind == mine.kind
            continue
        if its.place != mine.place:
            says_place &= bool(beaten)
        if its.place != mine.place or its.kind != mine.kind:
            says_kind &= bool(beaten)
        says_name &= bool(beaten)
    # Nor is a size a cause that may as well be none; beside a law of its place it is open anyway.
    if not any(pool[n].is_term and pool[n].place == mine.place for n in m.names):
        says_name &= not all(
            intervals[u.name][0] <= (u.neutral or 0.0) <= intervals[u.name][1]
            for u in m.picked[name].sizes
        )
    enough = takes_enough(weigher, without, m, LEFT_SHARE if is_first else 2.0 * LEFT_SHARE)
    taken2 = weigher.find_robust2(without) - weigher.find_robust2(m)
    little = bool((taken2 < NAME_SHARE**2 * weigher.find_robust2(base)).all())
    is_rest = not is_first and ((little and not says_place) or not enough)
    return Finding(
        mine, says_place, says_kind, says_name and not at_range and enough, *gained, numbers,
        at_range, bool(is_rest), tuple(sorted(judged, key=lambda j: j.behind_nats)),
    )  # fmt: skip


def _judge_rival(
    hypothesis: Hypothesis, lead: Array, *, beaten: bool, is_freer: bool
) -> JudgedRival:
    draws = bound_gain(lead, np.linspace(SURE, 1.0 - SURE, 199))
    loses = float((draws > 0.0).mean())
    interval = float(draws[0]), float(draws[-1])
    return JudgedRival(hypothesis, float(lead.sum()), interval, loses, beaten, is_freer)


def _list_numbers(m: WeighedModel, name: str, intervals: Intervals) -> tuple[FittedNumber, ...]:
    return tuple(
        fit_number(u.name, m.values[u.name], intervals[u.name])
        for u in m.picked[name].free
        if not u.name.startswith(HOME)
    )


def fit_number(name: str, value: float, interval: tuple[float, float]) -> FittedNumber:
    """Return a fitted number with its interval and unit; one of the measuring chain has none."""
    return FittedNumber(name, value, *interval, "" if name.startswith(CHAIN) else unit_of(name))


def takes_enough(
    weigher: Weigher, without: WeighedModel, m: WeighedModel, share: float = LEFT_SHARE
) -> bool:
    """Tell whether what a name takes off some channel is not small beside what stays there."""
    taken = weigher.find_imprint(without, m)
    left2 = weigher.find_robust2(m) / weigher.find_noise2(m) - 1.0
    there = int(taken.argmax())
    return bool(taken[there] > share * max(float(left2[there]), 0.0) ** 0.5)


def _may_rival(search: NameSearch, name: str, mine: Hypothesis) -> bool:
    return name in search.best_scores or search.pool[name].place == mine.place


def _choose_rivals(
    search: NameSearch, scored: list[EvidenceScore], mine: Hypothesis
) -> list[EvidenceScore]:
    """Return the best names and the best terms, and the best of another kind and place."""
    pool = search.pool
    named, terms = ([s for s in scored if pool[s.name].is_term is t] for t in (False, True))
    chosen = [*named[:RIVALS], *terms[: RIVALS // 2]]
    for rung in ("kind", "place"):
        outside = (s for s in scored if getattr(pool[s.name], rung) != getattr(mine, rung))
        first = next(outside, None)
        if first is not None and first not in chosen:
            chosen.append(first)
    return chosen
