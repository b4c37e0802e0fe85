"""The search: differential evolution (current-to-pbest), a generation at a time.

Every generation has a random generator of its own, made of the seed and its number, and starts
from the population before it: the same seed gives the same gains on any number of processes.
The search space is logarithmic: a factor of 2 is as large a step as a factor of 1/2.

A short trial does not see everything: gains that are calm through its one cycle may oscillate in
a whole experiment. So a rival that would come among the best is tried a second time, longer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.control.law import SearchSpace
from pamctl.control.law_registry import find_law, read_controller
from pamctl.tune.gains_trial import GainsTrial, Member

Floats = NDArray[np.float64]

_DIGITS = 4


def _round_gains(gains: dict[str, Any]) -> dict[str, Any]:
    return {
        name: _round_gains(value) if isinstance(value, dict) else float(f"{value:.{_DIGITS}g}")
        for name, value in gains.items()
    }


@dataclass(frozen=True)
class GainSpace:
    """The search space of a law."""

    space: SearchSpace

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Bounds of the search, in powers of ten."""
        return [(float(np.log10(a.low)), float(np.log10(a.high))) for a in self.space.axes]

    @property
    def usual(self) -> Floats:
        """The point where a search begins by default."""
        return np.log10([a.usual for a in self.space.axes])

    def gains(self, point: Floats) -> dict[str, Any]:
        """Return a point (powers of ten, shape (axes,)) as a gains file has it.

        The gains are rounded as the file will be: what is scored is what is written.
        """
        values = (10.0 ** np.asarray(point, dtype=np.float64)).tolist()
        numbers = dict(zip((a.name for a in self.space.axes), values, strict=True))
        return {**self.space.fixed, **_round_gains(self.space.to_gains(numbers))}

    def controller(self, point: Floats) -> Any:
        """Return a point as validated settings; None where its gains contradict each other."""
        try:
            return read_controller(self.gains(point))
        except ValueError:
            return None

    def point(self, gains: dict[str, Any]) -> Floats:
        """Return a gains file's keys as a point, moved inside the bounds."""
        numbers = self.space.from_gains(gains)
        found = [np.log10(max(numbers[a.name], a.low)) for a in self.space.axes]
        low, high = np.array(self.bounds).T
        inside: Floats = np.clip(found, low, high)
        return inside


def find_space(law: str, compensate: Sequence[str] = (), highest_hz: float = math.inf) -> GainSpace:
    """Return the space of an installed law; raise ValueError where it has none.

    Each of its gains also undoes the effects of `compensate`; cut-offs stay below `highest_hz`.
    """
    space = find_law(law).search
    if space is None:
        raise ValueError(
            f"the law {law!r} defines no search space; gains that exist can be scored with --check"
        )
    axes = tuple(
        a._replace(
            low=min(a.low, 0.1 * highest_hz),
            high=min(a.high, highest_hz),
            usual=min(a.usual, 0.9 * highest_hz),
        )
        if a.name.startswith("lpf")
        else a
        for a in space.axes
    )
    space = space._replace(axes=axes)
    if compensate:
        space = space._replace(fixed={**space.fixed, "compensate": list(compensate)})
    return GainSpace(space)


POPULATION_PER_AXIS = 5
START_SPREAD = 0.1
"""How far around the start half of the first population lies, in widths of the space."""
_BEST_SHARE = 0.2
_STRIDES = (0.4, 0.9)
_CROSSOVER_RATE = 0.8
_COST_LIMIT = 10.0
"""Larger costs are not computed exactly: an oscillation, or a safety trip."""
_NO_GAINS = 1e3
QUANTILE = 0.95
"""Quantile of the drawn plants that counts: the worst twentieth may be beyond any law."""


class BestGains(NamedTuple):
    """The best so far."""

    gains: dict[str, Any]
    cost: float
    generation: int
    evaluations: int
    """Trials of one plant each."""
    longer_evaluations: int = 0
    """Longer trials of one plant each, of what came among the best."""


class Jury(NamedTuple):
    """The plants that judge."""

    drawn: tuple[Member, ...]
    named: tuple[Member, ...]
    """Plants beside the drawn ones. The worst of them counts as much as all drawn ones."""

    @property
    def allowed_outliers(self) -> int:
        """How many drawn plants may exceed a limit that the quantile keeps."""
        last = len(self.drawn) - 1
        return last - math.floor(QUANTILE * last)


class Cost(NamedTuple):
    """The cost of a point, and the runs that it took."""

    value: float
    """Beyond the limit it is a lower bound."""
    runs: int
    ratios: tuple[float, ...] = ()
    """The ratio of each drawn plant; empty where not all of them were run."""


def compute_cost(
    controller: Any, limit: float, jury: Jury, trial: GainsTrial, order: Sequence[int]
) -> Cost:
    """Return the cost of gains: the largest error over its bound, named plants plus drawn ones.

    The quantile of the drawn ones counts. They run in the given order. As soon as the gains are
    known to exceed the limit, the other plants are left out.
    """
    if controller is None:
        return Cost(_NO_GAINS, 0)
    worst_named = 0.0
    for runs, member in enumerate(jury.named, 1):
        worst_named = max(worst_named, trial.verdict(controller, member).cost)
        if worst_named > limit:
            return Cost(worst_named, runs)
    ratios = np.full(len(jury.drawn), math.nan)
    for runs, at in enumerate(order, len(jury.named) + 1):
        ratios[at] = trial.verdict(controller, jury.drawn[at]).cost
        beyond = ratios[worst_named + ratios > limit]
        if len(beyond) > jury.allowed_outliers:
            return Cost(worst_named + float(beyond.min()), runs)
    of_drawn = float(np.quantile(ratios, QUANTILE)) if jury.drawn else 0.0
    return Cost(worst_named + of_drawn, len(jury.named) + len(jury.drawn), tuple(ratios.tolist()))


@dataclass
class GainsSearch:
    """A search for gains of one law before a jury of plants."""

    law: str
    jury: Jury
    seed: int
    start: dict[str, Any] | None = None
    """Gains, in mm, near which the search begins; by default the usual ones."""
    trial: GainsTrial = field(default_factory=GainsTrial)
    elite_trial: GainsTrial | None = None
    """Longer trial that gains must also stand to be among the best; or None."""
    compensate: tuple[str, ...] = ()
    """Effects that every candidate undoes; the gains name them."""
    watch: Callable[[float], object] = lambda share: None
    """Called with the share of a generation's trials that are done."""

    def __post_init__(self) -> None:
        """Draw the first population."""
        self._space = find_space(self.law, self.compensate, self.trial.highest_hz)
        self._order = list(range(len(self.jury.drawn)))
        self.generation = 0
        """How many are done."""
        self._runs = self._longer_runs = 0
        self._population = self._draw_population()
        self._costs = np.full(len(self._population), np.inf)

    def _draw_population(self) -> Floats:
        """Draw a Latin hypercube; its first half lies around the start."""
        low, high = np.array(self._space.bounds).T
        size, draw = POPULATION_PER_AXIS * len(low), np.random.default_rng(self.seed)
        rows = np.argsort(draw.random((size, len(low))), axis=0)
        population: Floats = low + (rows + draw.random(rows.shape)) / size * (high - low)
        start = self._space.usual if self.start is None else self._space.point(self.start)
        beside = START_SPREAD * draw.standard_normal((size // 2, len(low))) * (high - low)
        beside[0] = 0.0
        population[: size // 2] = np.clip(start + beside, low, high)
        return population

    def advance(self, executor: Executor | None = None) -> BestGains:
        """Go on by one generation; return the best so far."""
        points = self._population if self.generation == 0 else self._make_offspring()
        controllers = [self._space.controller(point) for point in points]
        everybody = np.arange(len(points))
        tried = self._try_gains(self.trial, controllers, everybody, executor)
        self._runs += sum(each.runs for each in tried)
        if self.elite_trial is not None:
            self._confirm_elite(tried, self.elite_trial, controllers, executor)
        costs = np.array([each.value for each in tried])
        better = costs < self._costs
        self._population = np.where(better[:, None], points, self._population)
        self._costs = np.where(better, costs, self._costs)
        self.generation += 1
        if better[np.argmin(self._costs)]:
            # A rival fails soonest on the plants that are hardest for the best: they run first.
            ratios = np.array(tried[int(np.argmin(self._costs))].ratios)
            if len(ratios):
                self._order = np.argsort(-ratios, kind="stable").tolist()
        return self.best

    def _try_gains(
        self,
        trial: GainsTrial,
        controllers: Sequence[Any],
        rivals: NDArray[np.int64],
        executor: Executor | None,
    ) -> list[Cost]:
        """Return the cost of some rivals, each up to that of the gains it would replace."""
        cost = partial(compute_cost, jury=self.jury, trial=trial, order=self._order)
        limits = np.minimum(self._costs[rivals], _COST_LIMIT).tolist()
        share_out = map if executor is None else executor.map
        found: list[Cost] = []
        for each in share_out(cost, [controllers[at] for at in rivals], limits):
            found.append(each)
            self.watch(len(found) / len(rivals))
        return found

    def _confirm_elite(
        self,
        tried: list[Cost],
        trial: GainsTrial,
        controllers: Sequence[Any],
        executor: Executor | None,
    ) -> None:
        """Try rivals that would be among the best for longer; raise their cost in `tried`.

        Who falls behind makes room for another, which is tried too. The worst of the best never
        gets worse, so whoever is among them in a later generation has been tried.
        """
        sure = np.zeros(len(tried), dtype=bool)
        while True:
            costs = np.array([each.value for each in tried])
            best = self._find_best(np.minimum(costs, self._costs))
            asked = best[~sure[best] & (costs[best] < self._costs[best])]
            if not len(asked):
                return
            longer = self._try_gains(trial, controllers, asked, executor)
            for at, found in zip(asked, longer, strict=True):
                tried[at] = found._replace(value=max(tried[at].value, found.value))
                self._longer_runs += found.runs
            sure[asked] = True

    @staticmethod
    def _find_best(costs: Floats) -> NDArray[np.int64]:
        """Return which are among the best, the best one first."""
        return np.argsort(costs, kind="stable")[: max(2, round(_BEST_SHARE * len(costs)))]

    def _make_offspring(self) -> Floats:
        """Return a rival for each: a stride towards one of the best and along a difference."""
        draw = np.random.default_rng([self.seed, self.generation])
        old = self._population
        size, axes = old.shape
        towards = old[draw.choice(self._find_best(self._costs), size)]
        one, other = old[draw.integers(size, size=(2, size))]
        stride = draw.uniform(*_STRIDES, (size, 1))
        new = old + stride * (towards - old + one - other)
        low, high = np.array(self._space.bounds).T
        new = np.where(new < low, 0.5 * (old + low), np.where(new > high, 0.5 * (old + high), new))
        crossed = draw.random((size, axes)) < _CROSSOVER_RATE
        crossed[np.arange(size), draw.integers(axes, size=size)] = True
        return np.where(crossed, new, old)

    @property
    def best(self) -> BestGains:
        """The best so far."""
        at = int(np.argmin(self._costs))
        return BestGains(
            self._space.gains(self._population[at]),
            float(self._costs[at]),
            self.generation,
            self._runs,
            self._longer_runs,
        )
