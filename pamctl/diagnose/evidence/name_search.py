"""The search: score, refit the best, take what counts; exchange and prune until nothing changes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pamctl.diagnose.evidence.constants import (
    EXCHANGE_SHARE,
    FIRST_SHARE,
    FIT_STEPS,
    KEPT,
    MOST_NAMES,
    NAME_NATS,
    NAME_SHARE,
    SHORTLIST,
)
from pamctl.diagnose.evidence.fit import WeighedModel, Weigher
from pamctl.diagnose.evidence.forecast import foretell_more
from pamctl.diagnose.evidence.measuring_chain import STOP, SWITCHED
from pamctl.diagnose.evidence.pool import Hypothesis, Variant
from pamctl.diagnose.evidence.scores import EvidenceScore, drop_name, extend_model, score_all

ROUGH_STEPS = 3
FITTED_AGAIN = 2
"""Hypotheses that are fitted again in a round for what they gained in one before."""
POLISHED = 4
"""Fits of a shortlist that are carried to the end."""

Tell = Callable[[str], None]


def list_at_range(m: WeighedModel, name: str) -> tuple[str, ...]:
    """Return the numbers of a name that are at an end of their range, and not at their neutral."""
    return tuple(u.name for u in m.picked[name].free if u.ends_at(m.values[u.name]))


def _gain_of(fitted: tuple[float, WeighedModel]) -> float:
    return fitted[0]


def _begin_anew(m: WeighedModel, picked: Mapping[str, Variant]) -> WeighedModel:
    """Return a model of these names, unfitted, from the plant file's numbers.

    Where a fit has led them, no tangent may lead back. What the names of `m` have freed stays.
    """
    names = (*m.names, *(n for n in picked if n not in m.names))
    found = {u.name for v in m.picked.values() for u in v.free}
    freed = [u for n in names for u in picked[n].free]
    numbers = (*(n for n in m.numbers if n.name not in found), *freed)
    x = [m.values[n.name] if n.name in found else n.value for n in numbers]
    taken, free = {k for v in m.picked.values() for k in v.held}, {u.name for u in freed}
    held = {k: v for k, v in m.held.items() if k not in taken | free}
    held |= {k: v for n in names for k, v in picked[n].held.items() if k not in free}
    return WeighedModel(names, numbers, held, np.array(x), {**picked})


def _put_last(m: WeighedModel, name: str) -> WeighedModel:
    """Return the same model with a name at the end, where the one that is judged stands."""
    return replace(m, names=(*(n for n in m.names if n != name), name))


class NameSearch:
    """The search over a pool, from a recalibrated model."""

    def __init__(
        self, weigher: Weigher, pool: Mapping[str, Hypothesis], tell: Tell = lambda _: None
    ) -> None:
        """Begin with nothing seen; `tell` hears what is done."""
        self.weigher, self.pool, self.tell = weigher, pool, tell
        self.found: WeighedModel | None = None
        """The best model so far, for a search that is interrupted."""
        self.best_scores: dict[str, float] = {}
        """The best gain that each hypothesis of a shortlist promised in any round."""
        self.best_fits: dict[str, float] = {}
        """The most that each hypothesis gained when it was fitted, in any round."""
        self._scored: dict[frozenset[str], list[EvidenceScore]] = {}
        self._without: dict[tuple[object, ...], WeighedModel] = {}
        self._fitted: dict[frozenset[str], WeighedModel] = {}

    def improve(self, base: WeighedModel, m: WeighedModel | None = None) -> WeighedModel:
        """Return the model that nothing improves; from a model with names, if one is given."""
        m = m or self.turn_columns(base)
        been, asked = set[frozenset[str]](), list(self.pool)
        while len(m.names) < MOST_NAMES and frozenset(m.names) not in been:
            round_s = -time.process_time()
            been.add(frozenset(m.names))
            self._fitted[frozenset(m.names)] = self.found = m
            self.weigher.set_floor(m)
            self.weigher.leave_out(m)
            scored = self.score(m, asked)
            for score in scored[:KEPT]:
                known = self.best_scores.get(score.name, 0.0)
                self.best_scores[score.name] = max(known, score.gain)
            best = ", ".join(f"{s.name} {s.gain:.0f}" for s in scored[:3])
            self.tell(f"{len(scored)} explanations asked; they promise, in nats: {best}")
            least = max(NAME_NATS, NAME_SHARE * scored[0].gain) if scored else 0.0
            hopeful = [s for s in scored if s.gain > least and s.shows]
            hopeful = [*hopeful[:SHORTLIST], *self._list_again(m, scored, hopeful)]
            taken = self.take(m, self.refit(m, hopeful, len(hopeful))) if hopeful else None
            if taken is None and self.weigher.is_far_off(m):
                anew = self._begin_all(m, lambda h: h.is_effect)
                taken = self.take(m, self._polish_best(m, anew)) if anew else None
            if taken is None:
                break
            taken = self.choose_form(m, taken)
            m = self.exchange(base, self.settle_anew(self.weigher.settle(taken, 4)))
            m = self.choose_forms_again(m)
            self.tell(foretell_more(self.weigher, m, round_s + time.process_time()))
        self.found = self.prune(m)
        return self.found

    def _list_again(
        self, m: WeighedModel, scored: Sequence[EvidenceScore], hopeful: Sequence[EvidenceScore]
    ) -> list[EvidenceScore]:
        """Return what gained most when it was fitted before, and promises little now.

        Where much is left, what a fit found is worth more than what a tangent promises.
        """
        if not self.weigher.is_much_left(m):
            return []
        known = [s for s in scored if s.name in self.best_fits and s not in hopeful[:SHORTLIST]]
        return sorted(known, key=lambda s: -self.best_fits[s.name])[:FITTED_AGAIN]

    def take(self, m: WeighedModel, fits: Sequence[WeighedModel]) -> WeighedModel | None:
        """Return the first that counts; what is too small by its name counts by no law either."""
        small = list[Hypothesis]()
        best = ", ".join(f"{f.names[-1]} {m.total - f.total:.0f}" for f in fits[:3])
        self.tell(f"fitted, they gain, in nats: {best}")
        for f in fits:
            its = self.pool[f.names[-1]]
            if self.weigher.counts(m, f) and not any(s.may_be(its) for s in small):
                return f
            if self.weigher.is_small(f):
                small.append(its)
        return None

    def settle_anew(self, m: WeighedModel) -> WeighedModel:
        """Return the model fitted again from the plant file's numbers, if that explains more.

        The own numbers first stood in for all that was missing: from where that took them, a fit
        may not find the way back, and a form was chosen there. So the names are fitted in their
        forms, and in their simplest ones. It is asked only where much is left.
        """
        weigher = self.weigher
        if not weigher.is_much_left(m):
            return m
        forms = [m.picked]
        simple = {n: min(self.pool[n].variants, key=lambda v: len(v.free)) for n in m.names}
        if any(len(simple[n].free) < len(m.picked[n].free) for n in m.names):
            forms.append(simple)
        best = m
        for picked in forms:
            anew = weigher.settle(_begin_anew(m, picked), FIT_STEPS)
            weigher.meet(best, anew)
            if anew.total < best.total:
                best = anew
        return best

    def turn_columns(self, base: WeighedModel) -> WeighedModel:
        """Return the model with the turned or shifted column that explains most, if one does.

        It is asked first, from the plant file's numbers: no tangent leads from one sign to another.
        """
        weigher = self.weigher
        if not weigher.is_much_left(base):
            return base
        columns = [h for h in self.pool.values() if h.kind in SWITCHED]
        turned = [_begin_anew(base, {h.name: h.variants[0]}) for h in columns]
        best = min([base, *map(weigher.settle, turned)], key=weigher.weigh_alone)
        weigher.meet(base, best)
        return best if best is not base and weigher.counts(base, best) else base

    def _begin_all(
        self, m: WeighedModel, asked: Callable[[Hypothesis], object]
    ) -> list[tuple[float, WeighedModel]]:
        """Return models with one name more, fitted from the plant file's numbers, and their gains.

        Far from the truth no tangent tells what a name is worth. Nothing leads to an end of the
        stroke, where the own numbers stood in for it. A valve's null without the leak that it feeds
        is wrong by half, and beside it a leak gains nothing. It is asked only where much is left,
        and of effects where that is a visible share of a channel's span.
        """
        weigher, floor2, found = self.weigher, self.weigher.floor2, []
        before = float(m.cost.by_block.sum())
        for h in self.pool.values() if weigher.is_much_left(m) else ():
            if asked(h) and self.fits_in(m, h):
                e = _begin_anew(m, {**m.picked, h.name: h.far or h.variants[0]})
                e = weigher.settle(e) if h.far else weigher.fit(e, ROUGH_STEPS)
                weigher.floor2 = floor2
                e.loss = weigher.like(e.d, floor2)
                found.append((before - float(e.cost.by_block.sum()), e))
        return found

    def score(self, m: WeighedModel, names: Sequence[str]) -> list[EvidenceScore]:
        """Return the scores of those names that a model may take, the best first.

        A model of the same names has about the same scores: they are not found again.
        """
        known = self._scored.setdefault(frozenset(m.names), [])
        new = {*names} - {s.name for s in known}
        asked = [self.pool[n] for n in names if n in new and self.fits_in(m, self.pool[n])]
        known += score_all(self.weigher, m, [h for h in asked if h.kind != STOP])
        known.sort(key=lambda s: -s.gain)
        return [s for s in known if s.name in {*names}]

    def drop(self, m: WeighedModel, name: str) -> WeighedModel:
        """Return the model refitted without a name, both weighed by what the poorer resolves."""
        weigher, key = self.weigher, (m.names, m.x.tobytes(), name)
        if key not in self._without:
            left = self._fitted.get(frozenset(m.names) - {name})
            self._without[key] = left or weigher.settle(drop_name(m, name), 5)
        weigher.meet(self._without[key], m)
        return self._without[key]

    def fit_in_place(self, m: WeighedModel, name: str, asked: Sequence[str]) -> list[WeighedModel]:
        """Return models with another name in the stead of one, from where the model stands.

        Without a large name its own numbers go far, from where no fit of another finds back.
        """
        near = drop_name(m, name)
        self.weigher.refine(near)
        self.weigher.set_floor(near)
        self.weigher.leave_out(near)
        able = [self.pool[n] for n in asked if self.fits_in(near, self.pool[n])]
        scored = score_all(self.weigher, near, able)
        return self.refit(near, scored, len(scored)) if scored else []

    def fits_in(self, m: WeighedModel, hypothesis: Hypothesis) -> bool:
        """Tell whether a hypothesis shares no numbers, and no term's part, with the model's."""
        inside = [self.pool[n] for n in m.names]
        return not any(
            h.family == hypothesis.family or (h.is_term and h.part == hypothesis.part)
            for h in inside
            if hypothesis.is_term or h.family == hypothesis.family
        )

    def choose(self, scored: Sequence[EvidenceScore], many: int) -> list[EvidenceScore]:
        """Return the best; for each free term among them, the two best names that may be it too."""
        chosen = list(scored[:many])
        for term in [self.pool[s.name] for s in chosen if self.pool[s.name].is_term]:
            names = [s for s in scored if self.pool[s.name].may_be(term)]
            chosen += [s for s in names[:2] if s not in chosen]
        return chosen

    def refit(
        self,
        m: WeighedModel,
        scored: Sequence[EvidenceScore],
        many: int = SHORTLIST,
        least: float = NAME_NATS,
    ) -> list[WeighedModel]:
        """Return fitted models with one hypothesis more each, the best first.

        All are fitted roughly, and to the end what then gains half of the best, and of `least`.
        """
        weigher = self.weigher
        before, rough = float(m.cost.by_block.sum()), list[tuple[float, WeighedModel]]()
        chosen = self.choose(scored, many)
        for score in chosen:
            e = weigher.fit(extend_model(weigher, m, score), ROUGH_STEPS, is_rough=True)
            rough.append((before - float(e.cost.by_block.sum()), e))
        rough += self._begin_all(m, lambda h: h.far)
        best = max(gain for gain, _ in rough)
        for k, score in enumerate(chosen):
            if rough[k][0] < best < score.gain:  # it promised more: the dose's tangent misled it
                e = weigher.fit(extend_model(weigher, m, score), ROUGH_STEPS)
                rough[k] = max(rough[k], (before - float(e.cost.by_block.sum()), e), key=_gain_of)
        return self._polish_best(m, rough, least)

    def _polish_best(
        self, m: WeighedModel, rough: list[tuple[float, WeighedModel]], least: float = NAME_NATS
    ) -> list[WeighedModel]:
        """Return models by what they gain, fitted to the end if a rough fit gains half of the best.

        It must gain half of `least`, too.
        """
        weigher = self.weigher
        for gain, e in rough:
            self.best_fits[e.names[-1]] = max(gain, self.best_fits.get(e.names[-1], 0.0))
        rough.sort(key=_gain_of, reverse=True)
        least, fits = 0.5 * max(least, *(gain for gain, _ in rough)), list[WeighedModel]()
        for gain, e in rough:
            worth = len(fits) < POLISHED and gain > least and weigher.may_be_seen(m, e)
            fits.append(weigher.polish(e) if worth else weigher.leave_out(e))
        fits.sort(key=self._rank)
        if fits and self.pool[fits[0].names[-1]].is_term:
            self._prefer_name(m, fits)
        return fits

    def _rank(self, e: WeighedModel) -> float:
        """Return a model's nats; of what does alike, an end that is seen elsewhere comes first."""
        return e.total - (NAME_NATS if self.pool[e.names[-1]].kind == STOP else 0.0)

    def choose_form(self, m: WeighedModel, e: WeighedModel) -> WeighedModel:
        """Return the form of a model's last name that does best; of equal ones the simplest.

        A form of which a number ends at its range is not the one, unless the first has that too.
        """
        weigher, its = self.weigher, self.pool[e.names[-1]]
        forms: dict[tuple[object, ...], list[Variant]] = {}
        for variant in its.variants:
            forms.setdefault(variant.form, []).append(variant)
        for form, variants in forms.items():
            if form == e.picked[its.name].form:
                continue
            scored = score_all(weigher, m, [replace(its, variants=tuple(variants))])
            for score in scored:
                other = weigher.polish(extend_model(weigher, m, score))
                is_inside = not list_at_range(other, its.name) or list_at_range(e, its.name)
                if is_inside and other.total + len(other.x) < e.total + len(e.x):
                    e = other
        return e

    def choose_forms_again(self, m: WeighedModel) -> WeighedModel:
        """Choose the forms of all names but the last again, where much is left.

        What was not in the model yet, such as a delay, made another form look better.
        """
        for name in m.names[:-1] if self.weigher.is_much_left(m) else ():
            if len({v.form for v in self.pool[name].variants}) > 1:
                without = self.drop(m, name)
                e = _put_last(m, name)
                other = self.choose_form(without, e)
                if other is not e:
                    self.tell(f"{name} has another form beside the others")
                    other.names = m.names
                    m = self.weigher.settle(other, 4)
        return m

    def _prefer_name(self, m: WeighedModel, fits: list[WeighedModel]) -> None:
        """Put a name before a freer term of its place that does little better."""
        first = fits[0]
        for e in fits[1:5]:
            if not self.pool[e.names[-1]].may_be(self.pool[first.names[-1]]):
                continue
            named = self.weigher.polish(e)
            if list_at_range(named, named.names[-1]):
                named = self.choose_form(m, named)
            if list_at_range(named, named.names[-1]):
                continue  # no name would be said
            if m.total - named.total > (1.0 - FIRST_SHARE) * (m.total - first.total):
                fits.remove(e)
                fits.insert(0, named)
                return

    def exchange(self, base: WeighedModel, m: WeighedModel) -> WeighedModel:
        """Drop names that count no longer, or put others in their place, while that helps.

        Where much is left, all stay until the end: what is not in the model yet may hide what a
        name is worth.
        """
        weigher = self.weigher
        for round_ in range(3 if len(m.names) > 1 else 0):
            weigher.meet(base, m)
            whole = base.total - m.total
            is_lost = weigher.is_much_left(m)
            for name in m.names if round_ else m.names[:-1]:
                without = self.drop(m, name)
                loss = without.total - m.total
                if not is_lost and not self.counts_in(without, m, name):
                    self.tell(f"{name} counts no longer: dropped")
                    m = weigher.settle(without, 4)
                    break
                if loss > EXCHANGE_SHARE * whole:
                    continue
                better = self._find_better(without, m, name, loss)
                if better is not None:
                    if better.names[-1] != name:
                        self.tell(f"{better.names[-1]} does better than {name}: exchanged")
                    m = weigher.settle(better, 4)
                    break
            else:
                return m
        return m

    def _find_better(
        self, without: WeighedModel, m: WeighedModel, name: str, loss: float
    ) -> WeighedModel | None:
        near = sorted(
            (n for n in self.best_scores if n != name), key=lambda n: -self.best_scores[n]
        )
        scored = self.score(without, near[:20])
        if not scored or scored[0].gain < 0.5 * loss:
            return None
        best = next(iter(self.refit(without, scored, 3)), None)
        return best if best is not None and best.total < m.total - NAME_NATS else None

    def counts_in(self, without: WeighedModel, m: WeighedModel, name: str) -> bool:
        """Tell whether a name counts in a model, against the model without it."""
        return self.weigher.counts(without, _put_last(m, name))

    def prune(self, m: WeighedModel) -> WeighedModel:
        """Drop what does not count beside the rest, the weakest first."""
        weigher = self.weigher
        while len(m.names) > 1:
            weak = []
            for name in m.names:
                without = self.drop(m, name)
                if not self.counts_in(without, m, name):
                    weak.append((without.total - m.total, name, without))
            if not weak:
                break
            _, name, without = min(weak, key=lambda w: w[0])
            self.tell(f"{name} does not count beside the rest: dropped")
            m = weigher.settle(without, 4)
        return m
