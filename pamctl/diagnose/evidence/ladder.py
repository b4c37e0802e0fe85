"""The ladder: place, kind and name of each finding, each said where all outside are beaten.

It is no chain. A name's rivals stand in its stead beside the rest of the model, fitted, under the
resolution of the model without it. A freer term of the same place can always mimic a name: it
speaks against it only where it clearly does better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pamctl.diagnose.evidence.constants import (
    FREER_SHARE,
    LEFT_SHARE,
    LEFT_TIMES,
    NAME_NATS,
    NAME_SHARE,
    RIVAL_SHARE,
    SURE,
)
from pamctl.diagnose.evidence.fit import KEPT_PROMISE, Array, WeighedModel, Weigher, bound_gain
from pamctl.diagnose.evidence.intervals import Intervals, find_intervals, widen_intervals
from pamctl.diagnose.evidence.measuring_chain import HOME
from pamctl.diagnose.evidence.name_search import NameSearch, list_at_range
from pamctl.diagnose.evidence.pool import CHAIN, Hypothesis
from pamctl.diagnose.evidence.run_pieces import APART_M, LATE_M
from pamctl.diagnose.evidence.scores import EvidenceScore
from pamctl.diagnose.plant_numbers import FittedNumber, unit_of

Doubt = Literal["", "law", "open", "freer", "range", "none", "part", "little", "larger"]
"""Why a name is not said: it is a law without one; another is not beaten; a law does better; a
number is at its range; it may be nothing; it may be a part of a law; it takes off little of what is
left; a larger finding is open."""
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
    is_better: bool
    """Whether it surely gains so much more that it speaks against the name all the same."""
    model: WeighedModel | None
    """The fitted model with it; None of one that is beaten."""
    idle_numbers: int = 0
    """So many more numbers it has, which gain nothing: for this alone it is beaten."""


@dataclass(frozen=True)
class Finding:
    """One thing that the model lacks, and how far up it may be said."""

    hypothesis: Hypothesis
    says_place: bool
    says_kind: bool
    doubt: Doubt
    """Why its name is not said; empty where it is."""
    gain_nats: float
    interval_nats: tuple[float, float]
    share: float
    """Of the gain of the whole model."""
    numbers: tuple[FittedNumber, ...]
    at_range: tuple[str, ...]
    """Numbers that stand at their range: then no name is said."""
    channel: int
    """Where it takes off most, over the sensor's noise."""
    is_rest: bool
    """Whether it is small beside what was found before it: it mends the model, and is no cause."""
    judged: tuple[JudgedRival, ...]
    """One of each name that was fitted, the nearest first."""
    is_judged: bool = True
    """Whether rivals were asked at all; not where the search was interrupted."""

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
        if not self.is_judged:
            return "unjudged"
        if self.is_rest:
            return "rest"
        if self.says_place and self.says_kind:
            return "kind" if self.doubt else "name"
        return "place" if self.says_place else "set"


def judge_names(
    search: NameSearch, base: WeighedModel, m: WeighedModel
) -> tuple[WeighedModel, list[Finding], Intervals]:
    """Return a model, what may be said of its names, and the interval of each of its numbers.

    A rival that is ahead takes the place of a name.
    """
    while True:
        findings, intervals = climb_ladder(search, base, m)
        rival = find_rival_ahead(findings, len(m.x))
        if rival is None:
            return m, findings, intervals
        search.tell(f"{rival.names[-1]} is ahead of what was found: going on with it")
        other = search.improve(base, search.weigher.settle(rival))
        if min(m, other, key=lambda e: search.weigher.weigh_alone(e) + len(e.x)) is m:
            return m, findings, intervals
        m = other


def find_rival_ahead(findings: Sequence[Finding], numbers: int) -> WeighedModel | None:
    """Return the fitted rival that explains surely more than what was found, if one does.

    Where a number of the finding stands at its range, a rival without one need only do as well: it
    is what the finding becomes there. A law without a name, in a model of so many `numbers`, gives
    way to what does as well with a nat for each number: a level curve is a constant.
    """
    ahead = [
        (j.behind_nats, j.model)
        for finding in findings
        for j in finding.judged
        if j.model is not None
        and not j.is_freer
        and not list_at_range(j.model, j.hypothesis.name)
        and (
            (j.behind_nats < -NAME_NATS and j.interval_nats[1] < 0.0)
            or (finding.at_range and j.behind_nats < NAME_NATS)
            or (finding.hypothesis.is_term and j.behind_nats < numbers - len(j.model.x))
        )
    ]
    return min(ahead, key=lambda rival: rival[0])[1] if ahead else None


def climb_ladder(
    search: NameSearch, base: WeighedModel, m: WeighedModel, *, judges: bool = True
) -> tuple[list[Finding], Intervals]:
    """Return what may be said of each name of a model, in the order in which they were found.

    Unless it `judges`, no rival is asked, and nothing is said. The intervals are those of all
    numbers, and reach to where a number is in a model that may be true instead: without what only
    mends this one, or with a rival that is not beaten.
    """
    intervals: Intervals = find_intervals(search.weigher, m)
    search.weigher.meet(base, m)
    whole = max(base.total - m.total, 1e-9)
    found = [_find_level(search, base, m, name, intervals, whole, judges) for name in m.names]
    found = [f if f.doubt or stands_alone(f, found) else replace(f, doubt="larger") for f in found]
    instead = [j.model for f in found for j in f.judged if j.model is not None and not j.is_freer]
    instead += [search.drop(m, f.name) for f in found if f.is_rest]
    intervals = widen_intervals(intervals, m, instead)
    tick = search.weigher.train.period_s
    found = [replace(f, judged=_keep_nearest(f.judged)) for f in found]
    return [replace(f, numbers=_list_numbers(m, f.name, intervals, tick)) for f in found], intervals


def _keep_nearest(judged: Sequence[JudgedRival]) -> tuple[JudgedRival, ...]:
    """Return one rival of each name, the nearest: a beaten one only where no other is there."""
    farthest_first = sorted(judged, key=lambda j: (not j.is_beaten, -j.behind_nats))
    kept = {rival.hypothesis.name: rival for rival in farthest_first}
    return tuple(sorted(kept.values(), key=lambda j: j.behind_nats))


def stands_alone(finding: Finding, found: Sequence[Finding]) -> bool:
    """Tell whether no larger law of its channel is open.

    A law is open if it has no name, or a number at its range. A smaller name may be a part of it.
    """
    return not any(
        (its.hypothesis.is_term or its.at_range)
        and its.gain_nats > finding.gain_nats
        and its.channel == finding.channel
        for its in found
    )


def _find_level(
    search: NameSearch, base: WeighedModel, m: WeighedModel, name: str, intervals: Intervals,
    whole: float, judges: bool,
) -> Finding:  # fmt: skip
    weigher, mine = search.weigher, search.pool[name]
    without, is_first = search.drop(m, name), name == m.names[0]
    own = without.left_out - m.left_out
    low, _, high = bound_gain(own)
    gained = float(own.sum()), (float(low), float(high)), float(own.sum()) / whole
    at_range = list_at_range(m, name)
    channel = int(weigher.find_imprint(without, m).argmax())
    is_small = not is_first and own.sum() < NAME_SHARE * whole
    if is_small or not judges:  # nobody asks for its rivals
        return Finding(
            mine, False, False, "little", *gained, (), at_range, channel, is_small, (), judges
        )
    judged = _judge_rivals(search, without, m, mine, own)
    open_ = [j.hypothesis for j in judged if not j.is_freer and not j.is_beaten]
    freer = [j.hypothesis for j in judged if j.is_freer and j.is_better]
    says_place = all(h.place == mine.place for h in open_)
    is_rough = weigher.is_much_left(m) and not takes_enough(weigher, without, m, LEFT_TIMES)
    says_kind = says_place and not is_rough and all(h.kind == mine.kind for h in (*open_, *freer))
    enough = takes_enough(weigher, without, m, LEFT_SHARE if is_first else 2.0 * LEFT_SHARE)
    may_be_none = _may_be_none(search, m, mine, intervals)
    doubts: dict[Doubt, bool] = {
        "law": mine.is_term, "open": bool(open_), "freer": bool(freer), "range": bool(at_range),
        "none": may_be_none, "part": _may_be_part(search, m, mine),
        "little": is_rough or not enough,
    }  # fmt: skip
    doubt: Doubt = next((why for why, holds in doubts.items() if holds), "")
    taken2 = weigher.find_robust2(without) - weigher.find_robust2(m)
    little = bool((taken2 < NAME_SHARE**2 * weigher.find_robust2(base)).all())
    unsure = has_unasked_rival(search.pool, m, mine) if mine.is_term else may_be_none
    doubted = unsure or (little and not says_place)
    is_rest = not enough or (doubted and not is_first)
    return Finding(
        mine, says_place, says_kind, doubt, *gained, (), at_range, channel, is_rest, tuple(judged)
    )


def _may_be_part(search: NameSearch, m: WeighedModel, mine: Hypothesis) -> bool:
    """Tell whether it may be a part of a law without a name that is missing too."""
    laws = (search.pool[n].laws for n in m.names if search.pool[n].is_term)
    return any(its & mine.laws for its in laws)


def has_unasked_rival(pool: Mapping[str, Hypothesis], m: WeighedModel, law: Hypothesis) -> bool:
    """Tell whether a law of its kind at another place cannot stand beside what was found before.

    A part of the plant holds one law without a name.
    """
    before = m.names[: m.names.index(law.name)]
    parts = {pool[name].part for name in before if pool[name].is_term}
    others = (h for h in pool.values() if h.is_term and h.part in parts)
    return any(h.kind == law.kind and h.place != law.place for h in others)


def _may_be_none(
    search: NameSearch, m: WeighedModel, mine: Hypothesis, intervals: Intervals
) -> bool:
    """Tell whether all its sizes may be neutral; beside a law of its place they are open anyway."""
    if any(search.pool[n].is_term and search.pool[n].place == mine.place for n in m.names):
        return False
    sizes = m.picked[mine.name].sizes
    return all(intervals[u.name][0] <= (u.neutral or 0.0) <= intervals[u.name][1] for u in sizes)


def _judge_rivals(
    search: NameSearch, without: WeighedModel, m: WeighedModel, mine: Hypothesis, own: Array
) -> list[JudgedRival]:
    """Fit what may stand in a name's stead; `own` is what the name gains, by block."""
    weigher, pool, gain = search.weigher, search.pool, float(own.sum())
    asked = [n for n in pool if n != mine.name and _may_rival(search, n, mine)]
    scored = _choose_rivals(search, search.score(without, asked), mine)
    promised = {s.name: s.gain for s in scored}
    # A rough fit may show less than half of what a rival gains: half of `gain` lets a quarter do.
    fits = search.refit(without, scored, len(scored), 0.5 * gain) if scored else []
    rivals = [r for r in fits if r.names[-1] != mine.name]
    if list_at_range(m, mine.name):  # there it may become another of its kind
        same = [n for n in asked if pool[n].kind == mine.kind and not pool[n].is_term]
        rivals += search.fit_in_place(m, mine.name, same)
    weigher.meet(without, m)
    least = m.total + RIVAL_SHARE * gain
    for close in [r for r in rivals if weigher.leave_out(r).total < least]:
        weigher.settle(close, 4)  # as the model was: on a ridge a fit goes on for long
    weigher.meet(without, m)
    judged = list[JudgedRival]()
    for rival in rivals:
        its, lead = pool[rival.names[-1]], weigher.leave_out(rival).left_out - m.left_out
        beaten, extra = _is_beaten(weigher, rival, m, lead, gain), len(rival.x) - len(m.x)
        idle = 0 if beaten or lead.sum() <= -extra else max(extra, 0)
        beaten |= idle > 0
        failed = rival.total > without.total - KEPT_PROMISE * promised.get(its.name, 0.0)
        if its.place == mine.place and failed:  # its fit failed: it may be true
            beaten &= promised.get(its.name, 0.0) < LEFT_SHARE * gain
        draws = bound_gain(lead, np.linspace(SURE, 1.0 - SURE, 199))
        judged.append(
            JudgedRival(
                its, float(lead.sum()), (float(draws[0]), float(draws[-1])),
                loses=float((draws > 0.0).mean()), is_beaten=beaten,
                is_freer=its.is_term and (its.place == mine.place or its.name in mine.akin),
                is_better=bool(bound_gain(-lead)[0] > FREER_SHARE * gain),
                model=None if beaten else replace(rival, tangent=None),
                idle_numbers=idle if beaten else 0,
            )
        )  # fmt: skip
    return judged


def _is_beaten(
    weigher: Weigher, rival: WeighedModel, m: WeighedModel, lead: Array, gain: float
) -> bool:
    """Tell whether a rival surely explains less."""
    least = bound_gain(lead)[0]
    is_less = least > NAME_NATS and takes_enough(weigher, rival, m)
    return bool(is_less or least > RIVAL_SHARE * gain)


def _list_numbers(
    m: WeighedModel, name: str, intervals: Intervals, period_s: float
) -> tuple[FittedNumber, ...]:
    """Return the fitted numbers of a name; a lateness is known to a sample, where rows are so."""
    numbers = []
    for u in m.picked[name].free:
        value, interval = m.values[u.name], intervals[u.name]
        if u.name == LATE_M and APART_M in m.values:
            value += m.values[APART_M]
            interval = value - period_s, value + period_s
        if not u.name.startswith(HOME):
            numbers.append(fit_number(u.name, value, interval))
    return tuple(numbers)


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
