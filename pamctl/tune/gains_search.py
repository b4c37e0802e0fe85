"""The search: differential evolution (current-to-pbest), a generation at a time.

Every generation has a random generator of its own, made of the seed and its number, and starts
from the population before it. An interrupted search therefore goes on exactly as if it had not
been interrupted, and the same seed gives the same gains on any number of processes.

A short trial does not see everything: gains that are calm through its one cycle may oscillate in
a whole experiment, or on a plant that is easy for others. So a rival that would come among the
best is tried a second time: longer, and on every plant.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.exit_codes import ExitCode
from pamctl.new_file import NewFileError, write_files
from pamctl.tune.gains_trial import GainsTrial
from pamctl.tune.plant_ensemble import Member
from pamctl.tune.search_space import find_space

Floats = NDArray[np.float64]

POPULATION_PER_AXIS = 5
START_SPREAD = 0.1
"""How far around the start half of the first population lies, in widths of the space."""
_BEST_SHARE = 0.2
_STRIDES = (0.4, 0.9)
_CROSSOVER_RATE = 0.8
_COST_LIMIT = 10.0
"""Larger costs are not computed exactly: an oscillation, or a safety trip."""
_NO_GAINS = 1e3


class SearchError(Exception):
    """A search cannot begin or continue. The message says why."""

    exit_code = ExitCode.USAGE


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
    quantile: float
    """Quantile of the drawn ones that counts: 1 is the worst one, 0.95 leaves out the worst 5 %."""
    named: tuple[Member, ...]
    """Plants beside the drawn ones. The worst of them counts as much as all drawn ones."""
    easy: tuple[Member, ...] = ()
    """Drawn plants that are run for the best gains only: for all others they count as easy."""

    @property
    def allowed_outliers(self) -> int:
        """How many drawn plants may exceed a limit that the quantile keeps."""
        last = len(self.drawn) + len(self.easy) - 1
        return last - math.floor(self.quantile * last)

    @property
    def whole(self) -> Jury:
        """The jury in which the easy ones are run as well, after the others."""
        return self._replace(drawn=(*self.drawn, *self.easy), easy=())


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

    The quantile of the drawn ones counts. They run in the given order, which may go on to plants
    that the jury does not have. As soon as the gains are
    known to exceed the limit, the other plants are left out.
    """
    if controller is None:  # these gains contradict each other
        return Cost(_NO_GAINS, 0)
    worst_named = 0.0
    for runs, member in enumerate(jury.named, 1):
        worst_named = max(worst_named, trial.verdict(controller, member).cost)
        if worst_named > limit:
            return Cost(worst_named, runs)
    ratios = np.full(len(jury.drawn), math.nan)
    own = [at for at in order if at < len(ratios)]
    for runs, at in enumerate(own, len(jury.named) + 1):
        ratios[at] = trial.verdict(controller, jury.drawn[at]).cost
        beyond = ratios[worst_named + ratios > limit]
        if len(beyond) > jury.allowed_outliers:
            return Cost(worst_named + float(beyond.min()), runs)
    all_drawn = np.concatenate([np.zeros(len(jury.easy)), ratios])
    of_drawn = float(np.quantile(all_drawn, jury.quantile)) if jury.drawn else 0.0
    return Cost(worst_named + of_drawn, len(jury.named) + len(jury.drawn), tuple(ratios.tolist()))


@dataclass
class GainsSearch:
    """A search for gains of one law before a jury of plants."""

    law: str
    jury: Jury
    seed: int
    start: dict[str, Any] | None = None
    """Gains, in mm, near which the search begins; by default the usual ones."""
    state: Path | None = None
    """File that keeps the search after each generation, so that it can be resumed."""
    trial: GainsTrial = field(default_factory=GainsTrial)
    elite_trial: GainsTrial | None = None
    """Longer trial that gains must also stand to be among the best, on the whole jury; or None."""
    compensate: tuple[str, ...] = ()
    """Effects that every candidate undoes; the gains name them."""

    def __post_init__(self) -> None:
        """Begin, or resume the search in `state`; raise `SearchError` if that is another one."""
        self._space = find_space(self.law, self.compensate)
        self._order = list(range(len(self.jury.whole.drawn)))
        self._generation = 0
        self._runs = self._longer_runs = 0
        self._population = self._draw_population()
        self._costs = np.full(len(self._population), np.inf)
        if self.state is not None and self.state.exists():
            self._resume(self.state)

    def _draw_population(self) -> Floats:
        from scipy.stats import qmc  # a second to import, and no worker process needs it

        low, high = np.array(self._space.bounds).T
        size = POPULATION_PER_AXIS * len(low)
        points = qmc.LatinHypercube(len(low), rng=self.seed).random(size)
        population: Floats = low + points * (high - low)
        start = self._space.usual if self.start is None else self._space.point(self.start)
        draw = np.random.default_rng(self.seed)
        beside = START_SPREAD * draw.standard_normal((size // 2, len(low))) * (high - low)
        beside[0] = 0.0
        population[: size // 2] = np.clip(start + beside, low, high)
        return population

    def advance(self, executor: Executor | None = None) -> BestGains:
        """Go on by one generation; return the best so far."""
        points = self._population if self._generation == 0 else self._make_offspring()
        controllers = [self._controller(point) for point in points]
        everybody = np.arange(len(points))
        tried = self._try_gains(self.jury, self.trial, controllers, everybody, executor)
        self._runs += sum(each.runs for each in tried)
        if self.elite_trial is not None:
            self._confirm_elite(tried, self.elite_trial, controllers, executor)
        costs = np.array([each.value for each in tried])
        better = costs < self._costs
        self._population = np.where(better[:, None], points, self._population)
        self._costs = np.where(better, costs, self._costs)
        self._generation += 1
        if better[np.argmin(self._costs)]:
            # A rival fails soonest on the plants that are hardest for the best: they run first.
            ratios = np.array(tried[int(np.argmin(self._costs))].ratios)
            if len(ratios):
                self._order = np.argsort(-ratios, kind="stable").tolist()
        self._save_state()
        return self.best

    def _try_gains(
        self,
        jury: Jury,
        trial: GainsTrial,
        controllers: Sequence[Any],
        rivals: NDArray[np.int64],
        executor: Executor | None,
    ) -> list[Cost]:
        """Return the cost of some rivals, each up to that of the gains it would replace."""
        cost = partial(compute_cost, jury=jury, trial=trial, order=self._order)
        limits = np.minimum(self._costs[rivals], _COST_LIMIT).tolist()
        share_out = map if executor is None else executor.map
        return list(share_out(cost, [controllers[at] for at in rivals], limits))

    def _confirm_elite(
        self,
        tried: list[Cost],
        trial: GainsTrial,
        controllers: Sequence[Any],
        executor: Executor | None,
    ) -> None:
        """Try rivals that would be among the best on the whole jury; raise their cost in `tried`.

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
            longer = self._try_gains(self.jury.whole, trial, controllers, asked, executor)
            for at, found in zip(asked, longer, strict=True):
                tried[at] = found._replace(value=max(tried[at].value, found.value))
                self._longer_runs += found.runs
            sure[asked] = True

    @staticmethod
    def _find_best(costs: Floats) -> NDArray[np.int64]:
        """Return which are among the best, the best one first."""
        return np.argsort(costs, kind="stable")[: max(2, round(_BEST_SHARE * len(costs)))]

    def _controller(self, point: Floats) -> Any:
        try:
            return self._space.controller(point)
        except ValueError:
            return None

    def _make_offspring(self) -> Floats:
        """Return a rival for each: a stride towards one of the best and along a difference."""
        draw = np.random.default_rng([self.seed, self._generation])
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
    def generation(self) -> int:
        """How many generations are done."""
        return self._generation

    @property
    def best(self) -> BestGains:
        """The best so far; raises `SearchError` before the first generation."""
        if self._generation == 0:
            raise SearchError("no gains have been tried yet")
        at = int(np.argmin(self._costs))
        return BestGains(
            self._space.gains(self._population[at]),
            float(self._costs[at]),
            self._generation,
            self._runs,
            self._longer_runs,
        )

    # --- interrupted, and taken up again -------------------------------------------------

    def _identity(self) -> dict[str, Any]:
        return {
            "law": self.law,
            "seed": self.seed,
            "quantile": self.jury.quantile,
            "easy": [member.name for member in self.jury.easy],
            "trial": self.trial.length,
            "elite_trial": self.elite_trial and self.elite_trial.length,
            "drawn": [member.name for member in self.jury.drawn],
            "named": [member.name for member in self.jury.named],
            "digest": self._digest(),
            "start": self.start,
        }

    def _digest(self) -> str:
        """Tell plants and spaces apart that changed and kept their names."""
        plants = (*self.jury.whole.drawn, *self.jury.named)
        text = [repr(self._space.space[:2]), *(repr(plant.__reduce__()[1]) for plant in plants)]
        return hashlib.sha256("\n".join(text).encode()).hexdigest()[:16]

    def _save_state(self) -> None:
        if self.state is None:
            return
        kept = {
            **self._identity(),
            "generation": self._generation,
            "runs": self._runs,
            "longer_runs": self._longer_runs,
            "order": self._order,
            "population": self._population.tolist(),
            "costs": self._costs.tolist(),
        }
        with suppress(NewFileError):  # the search goes on: only an interrupted one needs the file
            write_files({self.state: json.dumps(kept)}, replaces="{")

    def _resume(self, state: Path) -> None:
        try:
            kept = json.loads(state.read_text())
            mine = {name: kept[name] for name in self._identity()}
            population = np.array(kept["population"], dtype=np.float64)
            costs = np.array(kept["costs"], dtype=np.float64)
            generation = int(kept["generation"])
            runs, longer_runs = int(kept["runs"]), int(kept["longer_runs"])
            order = [int(at) for at in kept["order"]]
        except (ValueError, KeyError, TypeError) as error:
            raise SearchError(f"{state} is no search that could be resumed: {error}") from error
        if (
            mine != self._identity()
            or population.shape != self._population.shape
            or costs.shape != self._costs.shape
            or sorted(order) != sorted(self._order)
        ):
            raise SearchError(
                f"{state} belongs to another search (law, plants, bounds, seed or start differ); "
                "remove it, or ask for the same again"
            )
        self._generation, self._runs, self._longer_runs = generation, runs, longer_runs
        self._population, self._costs, self._order = population, costs, order
