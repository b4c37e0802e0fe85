"""Fit numbers of the plant to records, block by block, through the simulation's own integrator.

Output-error form: a block runs freely from the vented rest, driven by the other block's
measured signal, and its output is compared with the sensor. Residuals are counted in
deviations of the sensor, so that both blocks weigh alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from pamctl.diagnose.fitting.drives import RUNAWAY, Drive, stack_residuals
from pamctl.diagnose.fitting.numbers import FreeNumber, value_of, with_values
from pamctl.diagnose.measured.record import Array
from pamctl.plant.flat import NEUTRAL
from pamctl.plant.model import PlantSettings


@dataclass(frozen=True)
class Effort:
    """How far a fit is driven."""

    evaluations: int
    tolerance: float
    updates: int = 0
    """So many times derivatives are carried on by a rank-one update before they are made anew."""


QUICK = Effort(8, 1e-3, updates=2)
"""To compare candidates."""
FULL = Effort(15, 1e-6)
"""For numbers that are reported."""
STEP = 3e-3
"""Of a scale, for a derivative. The simulation is exact between events, so that a short step is
no worse than its rounding; a step a tenth long moves when the muscle sticks and slips, and such a
slope stops a fit in the valley of braid, stiffness and friction, well above its floor."""
LONG_STEP = 3e-2
"""To look beyond a kink, where the muscle begins to stick in another place."""
STUCK = 3
"""The optimiser's word for steps that shrank to nothing on a slope."""
ROBUST = 10.0
"""Residuals beyond so many times the usual one pull linearly only."""
HALVINGS = 10
"""Of a start from which the model runs away, until its effects are as good as neutral."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A plant fitted to training drives."""

    settings: PlantSettings
    free: tuple[FreeNumber, ...]
    drives: tuple[Drive, ...]
    residual: Array
    """At the solution, all drives one behind the other."""

    @cached_property
    def jacobian(self) -> Array:
        """Derivatives of the residual by the free numbers in their scales, shape (n, p)."""
        return sensitivity(self.drives, self.settings, self.free, self.residual)

    @cached_property
    def mean_square(self) -> float:
        """Of the residual, in deviations of the sensor."""
        return float(np.mean(self.residual**2))

    @property
    def values(self) -> dict[str, float]:
        """The fitted numbers by name."""
        return {free.name: value_of(self.settings, free.name) for free in self.free}

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Numbers that ended at an end of their range, a neutral value left out."""
        return tuple(
            free.name
            for free in self.free
            if min(self.values[free.name] - free.low, free.high - self.values[free.name])
            < 1e-3 * (free.high - free.low)
            and not (free.effect and abs(self.values[free.name] - NEUTRAL[free.name]) < free.scale)
        )


@dataclass(frozen=True)
class _Slope:
    """Derivatives at a point of the descent."""

    vector: Array
    residual: Array
    jacobian: Array
    age: int = 0
    """Updates since they were made."""

    def carry_to(self, vector: Array, residual: Array) -> _Slope:
        """Return the nearest derivatives that agree with the step just done (Broyden's update)."""
        step = vector - self.vector
        missed = residual - self.residual - self.jacobian @ step
        jacobian = self.jacobian + np.outer(missed, step / (step @ step))
        return _Slope(vector.copy(), residual.copy(), jacobian, self.age + 1)


def fit_numbers(
    drives: Sequence[Drive],
    start: PlantSettings,
    free: Sequence[FreeNumber],
    effort: Effort = FULL,
) -> Fit:
    """Fit `free` from where `start` stands; robust against what the model cannot show."""
    drives, free = tuple(drives), tuple(free)
    if not free:
        return Fit(start, (), drives, stack_residuals(drives, start))
    start, begun = _tame_start(drives, start, free)
    scale = np.array([f.scale for f in free])
    low = np.array([f.low for f in free]) / scale
    high = np.array([f.high for f in free]) / scale
    first = np.array([value_of(start, f.name) for f in free]) / scale
    first = np.clip(first, low, high)
    knee = ROBUST * max(float(np.median(np.abs(begun))) / 0.6745, 1.0)

    def settings_at(vector: Array) -> PlantSettings:
        numbers = dict(zip((f.name for f in free), np.clip(vector, low, high) * scale, strict=True))
        return with_values(start, numbers)

    known: list[tuple[Array, Array]] = []  # the optimiser asks for the slope where it just was

    def residual_at(vector: Array) -> Array:
        known[:] = [*known[-1:], (vector.copy(), stack_residuals(drives, settings_at(vector)))]
        return known[-1][1]

    def slope_at(vector: Array, step: float, last: list[_Slope]) -> Array:
        here = next((r for v, r in known if np.array_equal(v, vector)), None)
        settings = settings_at(vector)
        residual = stack_residuals(drives, settings) if here is None else here
        if last and last[0].age < effort.updates and not np.array_equal(last[0].vector, vector):
            last[0] = last[0].carry_to(vector, residual)
        else:
            slope = sensitivity(drives, settings, free, residual, step)
            last[:] = [_Slope(vector.copy(), residual.copy(), slope)]
        return last[0].jacobian.copy()  # the optimiser scales in place what it is given

    def descended(vector: Array, step: float) -> OptimizeResult:
        last: list[_Slope] = []
        return least_squares(
            residual_at,
            vector,
            lambda v: slope_at(v, step, last),
            bounds=(low, high),
            method="dogbox",
            loss="soft_l1",
            f_scale=knee,
            ftol=effort.tolerance,
            xtol=1e-6,
            gtol=1e-10,
            max_nfev=effort.evaluations,
        )

    found = descended(first, STEP)
    if found.status == STUCK:
        over = descended(descended(found.x, LONG_STEP).x, STEP)
        found = min(found, over, key=lambda result: float(result.cost))
    settings = settings_at(found.x)
    return Fit(settings, free, drives, stack_residuals(drives, settings))


def _tame_start(
    drives: Sequence[Drive], start: PlantSettings, free: Sequence[FreeNumber]
) -> tuple[PlantSettings, Array]:
    """Draw a start from which the model runs away back to its effects' neutral values.

    There no slope shows the way. Returns the start and its residual.
    """
    effects = [f.name for f in free if f.effect]
    for _ in range(HALVINGS):
        begun = stack_residuals(drives, start)
        if np.max(np.abs(begun)) < 0.5 * RUNAWAY:
            break
        nearer = {name: 0.5 * (value_of(start, name) + NEUTRAL[name]) for name in effects}
        start = with_values(start, nearer)
    return start, begun


def sensitivity(
    drives: Sequence[Drive],
    settings: PlantSettings,
    free: Sequence[FreeNumber],
    residual: Array,
    step: float = STEP,
) -> Array:
    """Derivatives of the stacked residual by each number in units of its scale, shape (n, p)."""
    columns = [_derivative(drives, settings, f, residual, step * f.scale) for f in free]
    return np.column_stack(columns) if columns else np.zeros((len(residual), 0))


def _derivative(
    drives: Sequence[Drive], settings: PlantSettings, free: FreeNumber, residual: Array, step: float
) -> Array:
    value = value_of(settings, free.name)
    if value + step > free.high:
        step = -step
    moved = with_values(settings, {free.name: value + step})
    return (stack_residuals(drives, moved) - residual) * (free.scale / step)


def secant(fitted: Fit, values: dict[str, float]) -> Array:
    """Return by how much these values move the simulated outputs, in deviations of the sensors."""
    moved = stack_residuals(fitted.drives, with_values(fitted.settings, values))
    return fitted.residual - moved


def project_out(basis: Array, vectors: Array) -> Array:
    """Remove the part of the vectors that lies in the span of an orthonormal basis."""
    rest: Array = vectors - basis @ (basis.T @ vectors)
    return rest


def rms(residual: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(residual**2)))
