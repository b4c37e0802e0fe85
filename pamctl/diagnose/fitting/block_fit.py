"""Fit numbers of the plant to records, block by block, through the simulation's own integrator.

Output-error form: a block runs freely from the vented rest, driven by the other block's measured
signal, and its output is compared with the sensor. The unit of a residual is the standard
deviation of the sensor, so that both blocks weigh the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import log
from operator import is_not

import numpy as np
from pydantic import ValidationError

from pamctl.descent import Descent, DescentEnd, descend
from pamctl.diagnose.fitting.coarse_steps import coarsen
from pamctl.diagnose.fitting.drives import RUNAWAY, Drive, move_residuals, stack_residuals
from pamctl.diagnose.fitting.numbers import FreeNumber, value_of, with_values
from pamctl.diagnose.measured.record import Array
from pamctl.plant.flat import NEUTRAL
from pamctl.plant.model import PlantSettings


@dataclass(frozen=True)
class Effort:
    """How far the optimiser goes."""

    evaluations: int
    tolerance: float
    updates: int = 0
    """Rank-one updates of the derivatives before they are computed again."""
    most_rounds: int = 1
    """Rounds of `evaluations`; another follows while the last one still gained `PROGRESS`."""
    ends_fine: bool = True
    """After half the steps of the simulation, it goes on with all of them."""


QUICK = Effort(8, 1e-3, updates=2, ends_fine=False)
"""To compare candidates."""
FULL = Effort(15, 1e-6, updates=1, most_rounds=10)
"""For numbers that are reported."""
STEP = 3e-3
"""Step of a derivative, in scales of the number. The simulation is exact between events, so a short
step costs only rounding. A step of 0.1 moves the moments at which the muscle sticks and slips; with
such slopes a fit stops in the valley of braid, stiffness and friction, well above its floor."""
LONG_STEP = 3e-2
"""Step that reaches beyond a kink, where the muscle begins to stick in another place."""
PROGRESS = 0.01
"""A fit goes on while a round reduces its cost by more than this share."""
ROBUST = 10.0
"""Residuals above this multiple of the usual one count linearly, not by their square."""
LOGARITHMIC = 12.0
"""A plant's number whose range spans more than this factor is fitted by its logarithm."""
AT_END = 1e-3
"""A number this near to an end of its range, as a share of the range, is at its bound."""
BISECTIONS = 40
"""Halvings that find the end of a plant's own range."""
HALVINGS = 10
"""Halvings of the effects at a start from which the model runs away; then they are neutral."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A plant fitted to training drives."""

    settings: PlantSettings
    free: tuple[FreeNumber, ...]
    drives: tuple[Drive, ...]
    residual: Array
    """At the solution; all drives, one after the other."""

    @cached_property
    def jacobian(self) -> Array:
        """Derivatives of the residual by the free numbers in their scales, shape (n, p)."""
        return sensitivity(self.drives, self.settings, self.free)

    def solve(self, residual: Array) -> Array:
        """Return the step of the numbers, in their scales, that is nearest to a residual's change.

        The normal equations do: the numbers' scales make the columns alike.
        """
        change: Array = self._inverse_square @ (self.jacobian.T @ residual)
        return change

    @cached_property
    def _inverse_square(self) -> Array:
        square = self.jacobian.T @ self.jacobian
        return np.asarray(np.linalg.pinv(square, hermitian=True), dtype=np.float64)

    @cached_property
    def mean_square(self) -> float:
        """Mean square of the residual, in squared deviations of the sensor."""
        return float(np.mean(self.residual**2))

    @property
    def values(self) -> dict[str, float]:
        """The fitted numbers by name."""
        return {free.name: value_of(self.settings, free.name) for free in self.free}

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Numbers at an end of their range; an effect at its neutral value does not count."""
        return tuple(
            free.name
            for free in self.free
            if _is_at_end(free, self.values[free.name])
            and not (free.effect and abs(self.values[free.name] - NEUTRAL[free.name]) < free.scale)
        )


def is_logarithmic(free: FreeNumber) -> bool:
    """Tell whether a number of the plant spans decades; effects keep their own scale."""
    return free.effect is None and free.low > 0.0 and free.high > LOGARITHMIC * free.low


def _is_at_end(free: FreeNumber, value: float) -> bool:
    low, high = free.low, free.high
    if is_logarithmic(free):
        low, high, value = log(low), log(high), log(max(value, free.low))
    return min(value - low, high - value) < AT_END * (high - low)


@dataclass(frozen=True)
class _Slope:
    """Derivatives at a point of the descent."""

    vector: Array
    residual: Array
    jacobian: Array
    step: float
    """Step of the derivatives, in scales."""
    age: int = 0
    """Updates since the derivatives were computed."""

    def carry_to(self, vector: Array, residual: Array) -> _Slope:
        """Return the nearest derivatives that agree with the last step (Broyden's update)."""
        step = vector - self.vector
        if not step.any():
            return self
        missed = residual - self.residual - self.jacobian @ step
        jacobian = self.jacobian + np.outer(missed, step / (step @ step))
        return _Slope(vector.copy(), residual.copy(), jacobian, self.step, self.age + 1)


def fit_numbers(
    drives: Sequence[Drive],
    start: PlantSettings,
    free: Sequence[FreeNumber],
    effort: Effort = FULL,
) -> Fit:
    """Fit the numbers `free` from the values of `start`; robust to what the model cannot show."""
    drives, free = tuple(drives), limit_to_plant(free, start)
    settings = _fit_settings(drives, start, free, effort) if free else start
    return Fit(settings, free, drives, stack_residuals(drives, settings))


def _fit_settings(
    drives: tuple[Drive, ...], start: PlantSettings, free: Sequence[FreeNumber], effort: Effort
) -> PlantSettings:
    """Descend with half the steps of the simulation, then with all of them."""
    coarse = coarsen(drives, start, free=free)
    start, residual = _limit_start(coarse, start, free)
    problem = _LeastSquares(coarse, start, free, effort, find_knee(residual))
    result = problem.descend(problem.first, STEP)
    if result.ending is DescentEnd.STUCK:
        over = problem.descend(problem.descend(result.vector, LONG_STEP).vector, STEP)
        result = min(result, over, key=lambda r: r.cost)
    if effort.ends_fine and any(map(is_not, coarse, drives)):
        problem.refine(drives, result.vector)
        result = problem.descend(result.vector, STEP)
    return problem.settings_at(result.vector)


def find_knee(residual: Array) -> float:
    """Return the size above which a residual counts linearly, where these are left at the start."""
    return ROBUST * max(float(np.median(np.abs(residual))) / 0.6745, 1.0)


class _LeastSquares:
    """A fit as the optimiser sees it: a vector of numbers in their scales, and the residual."""

    def __init__(
        self,
        drives: Sequence[Drive],
        start: PlantSettings,
        free: Sequence[FreeNumber],
        effort: Effort,
        knee: float,
    ) -> None:
        self.drives, self.start, self.free = drives, start, free
        self.effort, self.knee = effort, knee
        self.scale = np.array([f.scale for f in free])
        values = np.array([value_of(start, f.name) for f in free])
        low, high = np.array([f.low for f in free]), np.array([f.high for f in free])
        self.is_log = np.array([is_logarithmic(f) for f in free])
        # The unit of a logarithm is the scale at the start: there, both kinds of steps are equal.
        self.middle = np.where(self.is_log, np.clip(values, low, high), 1.0)
        self.low, self.high = self._to_vector(low), self._to_vector(high)
        self.first: Array = np.clip(self._to_vector(values), self.low, self.high)
        # The optimiser needs the slope where it has just computed the residual.
        self._last_residuals: list[tuple[Array, Array]] = []
        self._slope: _Slope | None = None

    def _to_vector(self, values: Array) -> Array:
        ratio = np.maximum(np.where(self.is_log, values / self.middle, 1.0), 1e-300)
        vector: Array = np.where(self.is_log, np.log(ratio) * self.middle, values) / self.scale
        return vector

    def _to_values(self, vector: Array) -> Array:
        inside = np.clip(vector, self.low, self.high) * self.scale
        exponent = np.where(self.is_log, inside / self.middle, 0.0)
        values: Array = np.where(self.is_log, self.middle * np.exp(exponent), inside)
        return values

    def descend(self, vector: Array, step: float) -> Descent:
        """Minimise from a vector, with derivatives by differences of `step` scales."""
        result = self._descend_round(vector, step)
        for _ in range(self.effort.most_rounds - 1):
            if result.ending is not DescentEnd.EVALUATIONS:
                break
            before, self._slope = result.cost, None
            result = self._descend_round(result.vector, step)
            if result.cost > (1.0 - PROGRESS) * before:
                break
        return result

    def refine(self, drives: Sequence[Drive], vector: Array) -> None:
        """Go on with other steps of the simulation, on which the derivatives hardly depend."""
        slope, known = self._slope, self._recall_residual(vector)
        if slope is not None and known is not None and not np.array_equal(slope.vector, vector):
            slope = slope.carry_to(vector, known)
        self.drives, self._last_residuals = drives, []
        residual = self._residual_at(vector)
        self.knee = find_knee(residual)
        self._slope = None
        if slope is not None and known is not None:
            self._slope = replace(slope, residual=residual, age=0)

    def _descend_round(self, vector: Array, step: float) -> Descent:
        return descend(
            self._residual_at,
            lambda v: self._jacobian_at(v, step),
            vector,
            self.low,
            self.high,
            knee=self.knee,
            tolerance=self.effort.tolerance,
            evaluations=self.effort.evaluations,
        )

    def settings_at(self, vector: Array) -> PlantSettings:
        """Return the plant with the numbers of a vector."""
        values = self._to_values(vector)
        return with_values(self.start, dict(zip((f.name for f in self.free), values, strict=True)))

    def _residual_at(self, vector: Array) -> Array:
        try:
            residual = stack_residuals(self.drives, self.settings_at(vector))
        except ValidationError:  # each number is within its range, but not all together
            residual = np.full(sum(d.samples for d in self.drives), RUNAWAY)
        self._last_residuals = [*self._last_residuals[-1:], (vector.copy(), residual)]
        return residual

    def _recall_residual(self, vector: Array) -> Array | None:
        return next((r for v, r in self._last_residuals if np.array_equal(v, vector)), None)

    def _jacobian_at(self, vector: Array, step: float) -> Array:
        settings, last = self.settings_at(vector), self._slope
        residual = self._recall_residual(vector)
        if residual is None:
            residual = stack_residuals(self.drives, settings)
        if last is not None and last.step == step and last.age < self.effort.updates:
            self._slope = last.carry_to(vector, residual)
        else:
            slope = sensitivity(self.drives, settings, self.free, step)
            # Along a logarithm the number moves in proportion to itself.
            jacobian = slope * np.where(self.is_log, self._to_values(vector) / self.middle, 1.0)
            self._slope = _Slope(vector.copy(), residual.copy(), jacobian, step)
        return self._slope.jacobian


def limit_to_plant(free: Sequence[FreeNumber], settings: PlantSettings) -> tuple[FreeNumber, ...]:
    """Return the numbers with ranges that end where a plant file's own limits do."""
    lows, highs = {f.name: f.low for f in free}, {f.name: f.high for f in free}
    if _is_valid(settings, lows) and _is_valid(settings, highs):
        return tuple(free)
    return tuple(map(partial(_limit_number, settings=settings), free))


def _limit_number(free: FreeNumber, settings: PlantSettings) -> FreeNumber:
    value = value_of(settings, free.name)
    low, high = (_find_last_valid(settings, free.name, value, end) for end in (free.low, free.high))
    return free if (low, high) == (free.low, free.high) else replace(free, low=low, high=high)


def _find_last_valid(settings: PlantSettings, name: str, inside: float, end: float) -> float:
    """Return the value nearest to `end`, on the way from `inside`, that a plant may have."""
    if _is_valid(settings, {name: end}):
        return end
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + end)
        if _is_valid(settings, {name: middle}):
            inside = middle
        else:
            end = middle
    return inside


def _is_valid(settings: PlantSettings, values: Mapping[str, float]) -> bool:
    try:
        with_values(settings, values)
    except ValidationError:
        return False
    return True


def _limit_start(
    drives: Sequence[Drive], start: PlantSettings, free: Sequence[FreeNumber]
) -> tuple[PlantSettings, Array]:
    """Move a start from which the model runs away towards its effects' neutral values.

    Where the model runs away, no slope shows the way. Returns the start and its residual.
    """
    effects = [f.name for f in free if f.effect]
    for _ in range(HALVINGS):
        residual = stack_residuals(drives, start)
        if np.max(np.abs(residual)) < 0.5 * RUNAWAY:
            break
        nearer = {name: 0.5 * (value_of(start, name) + NEUTRAL[name]) for name in effects}
        start = with_values(start, nearer)
    return start, residual


def sensitivity(
    drives: Sequence[Drive],
    settings: PlantSettings,
    free: Sequence[FreeNumber],
    step: float = STEP,
) -> Array:
    """Return derivatives of the stacked residual by each number in its scale, shape (n, p)."""
    steps = [_choose_step(settings, f, step * f.scale) for f in free]
    moved = [
        with_values(settings, {f.name: value_of(settings, f.name) + own})
        for f, own in zip(free, steps, strict=True)
    ]
    times = np.array([f.scale / own for f, own in zip(free, steps, strict=True)])
    slopes: Array = move_residuals(coarsen(drives, settings), settings, moved) * times
    return slopes


def _choose_step(settings: PlantSettings, free: FreeNumber, step: float) -> float:
    """Return the step, or its opposite where a range ends, or where another number is the limit."""
    value = value_of(settings, free.name)
    if value + step > free.high:
        return -step
    return step if _is_valid(settings, {free.name: value + step}) else -step


def find_secants(fitted: Fit, doses: Sequence[dict[str, float]]) -> Array:
    """Return by how much doses move the simulated outputs, in deviations, shape (n, doses)."""
    moved = [with_values(fitted.settings, dose) for dose in doses]
    drives = coarsen(fitted.drives, fitted.settings, *moved)
    return -move_residuals(drives, fitted.settings, moved)


def find_change(fitted: Fit, altered: Sequence[Drive]) -> Array:
    """Return by how much the residual of a fit changes on altered drives, in deviations, (n,)."""
    as_fitted, changed = (coarsen(d, fitted.settings) for d in (fitted.drives, altered))
    if [d.steps for d in as_fitted] != [d.steps for d in changed]:
        return stack_residuals(altered, fitted.settings) - fitted.residual
    here = stack_residuals(as_fitted, fitted.settings)
    return stack_residuals(changed, fitted.settings) - here


def project_out(basis: Array, vectors: Array) -> Array:
    """Remove the part of the vectors that lies in the span of an orthonormal basis."""
    rest: Array = vectors - basis @ (basis.T @ vectors)
    return rest


def rms(residual: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(residual**2)))
