"""A suspect's fit: its number beside the recalibrated ones, in all blocks that show it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from pamctl.descent import DescentEnd, descend
from pamctl.diagnose.fitting.block_fit import (
    LONG_STEP,
    STEP,
    Fit,
    find_change,
    find_knee,
    project_out,
    rms,
    sensitivity,
)
from pamctl.diagnose.fitting.coarse_steps import coarsen
from pamctl.diagnose.fitting.drives import MECHANICS, Drive, stack_residuals
from pamctl.diagnose.fitting.fitted_model import FORM_SHARE, Model
from pamctl.diagnose.fitting.numbers import value_of, with_values
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.setup.suspects import CONSTANTS, GASES, Suspect
from pamctl.plant.model import PlantSettings

FIRST_EVALUATIONS = 6
EVALUATIONS = 15
HOPELESS_SHARE = 0.7
"""A descent that has left more than this share of the base's squares in every fit after its first
evaluations ends there."""
HALF_WAY, FAR = 0.5, 5.0
"""A fit that closes more than this share of a block's gap and leaves more than this multiple of its
limit may have ended in a valley beside its cause."""
TOLERANCE = 1e-4
"""A descent ends when a step reduces the cost by less than this share."""
NEVER = 1e3
"""A knee at this multiple of the largest residual bends nothing."""
STRETCH_S = 1.0
"""Scores are summed over stretches of this length for the interval."""


@dataclass(frozen=True)
class Promise:
    """What a suspect promises to first order."""

    suspect: Suspect
    explained: float
    """Share of the square of what is left, in the blocks above their limits."""
    start: float


@dataclass(frozen=True, eq=False)
class SuspectFit:
    """A base model with a suspect's number fitted beside its own."""

    base: Model
    suspect: Suspect
    amount: float
    half: float
    """Half the 90 % interval of the amount."""
    fits: Mapping[frozenset[str], Fit]
    """On the altered drives; blocks that the suspect does not reach are missing."""
    by_record: Mapping[str, float] = field(default_factory=dict)
    """Amounts by record, for a number that differs between them; `amount` is their span."""
    equal_suspects: tuple[str, ...] = ()
    """Other suspects that explain as much."""
    promised: float = 0.0
    """What it promised to first order."""

    def apply(self, drive: Drive) -> Drive:
        """Return the drive as it is with what was found."""
        amount = self.by_record.get(drive.name, self.amount) if self.by_record else self.amount
        return self.suspect.apply(drive, amount)

    def value_and_interval(self) -> tuple[float, tuple[float, float], float | None]:
        """Return the value, its 90 % interval, and what the plant file says of it, if anything."""
        suspect, half = self.suspect, self.half
        if suspect.kind == "plant_constant":
            said = value_of(self.base.evidence.nominal, suspect.number)
            value = said * (1.0 + self.amount)
            return value, (value - said * half, value + said * half), said
        value = self.amount + (1.0 if suspect.kind in ("scale", "sign") else 0.0)
        return value, (value - half, value + half), None

    @property
    def is_credible(self) -> bool:
        """Tell whether a gas has the value that was found, where the number is a gas's."""
        least, most = GASES.get(self.suspect.number, (-np.inf, np.inf))
        return bool(least <= self.value_and_interval()[0] <= most)

    @property
    def is_good(self) -> bool:
        """Tell whether it brings every block that it reaches to its limit."""
        return all(self.is_explained(b) for b in self.suspect.blocks)

    @cached_property
    def residuals(self) -> dict[str, Array]:
        """Held-out residuals by block, in deviations of the sensor."""
        left = dict(self.base.residuals)
        for blocks, fitted in self.fits.items():
            for block in blocks:
                drives = [self.apply(d) for d in self.base.evidence.holdout[block]]
                left[block] = stack_residuals(drives, fitted.settings)
        return left

    def ratio(self, block: str) -> float:
        """Return held-out RMS over the base's floor."""
        return rms(self.residuals[block]) / self.base.floors[block].mean

    def is_explained(self, block: str) -> bool:
        """Tell whether a block is at its limit; a little of what was explained may be left."""
        limit = self.base.floors[block].limit
        before = FORM_SHARE * self.base.rms[block]
        return rms(self.residuals[block]) <= float(np.hypot(limit, before))

    def closed(self, block: str) -> float:
        """Return the share of the way from the recalibrated model to the floor."""
        way = self.base.rms[block] - self.base.floors[block].mean
        return float((self.base.rms[block] - rms(self.residuals[block])) / way) if way > 0 else 1.0

    @property
    def is_at_bound(self) -> bool:
        """Tell whether the amount is at an end of its range."""
        width = self.suspect.high - self.suspect.low
        return min(self.amount - self.suspect.low, self.suspect.high - self.amount) < 1e-3 * width


def reached_fits(base: Model, suspect: Suspect) -> dict[frozenset[str], Fit]:
    """Return the fits of the base that a suspect touches."""
    return {blocks: f for blocks, f in base.fits.items() if blocks & suspect.blocks}


def weights_of(base: Model, fitted: Fit) -> Array:
    """Return the weight of each row of a fit: its unit becomes the floor of its block."""
    units = {
        block: base.evidence.holdout[block][0].deviation * base.floors[block].mean
        for block in base.evidence.blocks
    }
    return np.concatenate([np.full(d.samples, d.deviation / units[d.block]) for d in fitted.drives])


def find_excess(base: Model, fitted: Fit) -> float:
    """Return the share of a fit's square that is above its floors: only that can be explained."""
    squares = float(np.mean((weights_of(base, fitted) * fitted.residual) ** 2))
    return max(1.0 - 1.0 / squares, 0.0)


_BASES: WeakKeyDictionary[Fit, tuple[Array, Array, Array]] = WeakKeyDictionary()
"""By fit, for the weights it was asked with: every suspect is scored upon the same basis."""


def find_movable_basis(base: Model, fitted: Fit) -> tuple[Array, Array, Array]:
    """Return the weights of a fit's rows, an orthonormal basis of what its numbers can change, and
    what is left of the residual beside it. A number at its bound is left out.
    """
    weight = weights_of(base, fitted)
    known = _BASES.get(fitted)
    if known is None or not np.array_equal(known[0], weight):
        bound = fitted.at_bound
        movable = [i for i, f in enumerate(fitted.free) if f.name not in bound]
        basis = np.linalg.qr(weight[:, None] * fitted.jacobian[:, movable])[0]
        _BASES[fitted] = known = weight, basis, project_out(basis, weight * fitted.residual)
    return known


def score_suspect(base: Model, suspect: Suspect) -> Promise:
    """Return what a suspect promises, by one simulation a dose."""
    touched = reached_fits(base, suspect)
    weights, bases, left = zip(
        *(find_movable_basis(base, fitted) for fitted in touched.values()), strict=True
    )
    before = sum(float(r @ r) for r in left)
    best = Promise(suspect, 0.0, 0.0)
    for dose in (d for d in suspect.doses if suspect.low <= d <= suspect.high):
        parts = []
        for fitted, basis, weight in zip(touched.values(), bases, weights, strict=True):
            altered = [suspect.apply(d, dose) for d in fitted.drives]
            parts.append(project_out(basis, weight * find_change(fitted, altered)))
        size = sum(float(m @ m) for m in parts)
        if not size > 1e-6 * before:
            continue
        times = -sum(float(m @ r) for m, r in zip(parts, left, strict=True)) / size
        times = min(max(times, 0.0), 4.0)
        after = sum(float(np.sum((r + times * m) ** 2)) for m, r in zip(parts, left, strict=True))
        explained = 1.0 - after / before
        if explained > best.explained:
            start = float(np.clip(times * dose, 0.98 * suspect.low, 0.98 * suspect.high))
            best = Promise(suspect, explained, start)
    return best


def fit_suspect(
    base: Model, suspect: Suspect, start: float, *, is_near: bool = False
) -> SuspectFit:
    """Fit a suspect's number and the recalibrated numbers together, from a start.

    Where something sticks, or the fit ends half way, the plant file's own numbers are tried as a
    start as well: what the base lacks may have led it into a valley that has no way out. With
    `is_near` the base's numbers are the only start.
    """
    near = _descend(base, suspect, None, start, STEP)
    drives = [d for f in near.fits.values() for d in f.drives]
    sticks = any(d.block == MECHANICS or not d.has_position for d in drives)
    if is_near or not (sticks or _ends_half_way(near)):
        return near
    found = _descend(base, suspect, base.evidence.nominal, start, LONG_STEP)
    return min((near, found), key=lambda f: sum(_mean_squares(f)))


def _ends_half_way(fitted: SuspectFit) -> bool:
    """Tell whether a suspect explains most of a block, and yet leaves far more than its limit."""
    return any(
        fitted.closed(b) > HALF_WAY and rms(fitted.residuals[b]) > FAR * fitted.base.floors[b].limit
        for b in fitted.suspect.blocks
    )


def _mean_squares(fitted: SuspectFit) -> list[float]:
    """Return the training residuals of each fit, in floors."""
    return [
        float(np.mean((weights_of(fitted.base, f) * f.residual) ** 2)) for f in fitted.fits.values()
    ]


def _descend(
    base: Model, suspect: Suspect, settings: PlantSettings | None, start: float, step: float
) -> SuspectFit:
    """Descend from the numbers of `settings`, or from the base's; end with a short step."""
    touched = reached_fits(base, suspect)
    problem = _Problem(base, suspect, touched, settings)
    vector = problem.vector_at(start)
    for length in dict.fromkeys((step, STEP)):
        problem.step = length
        # A start may leave hundreds of times what the end does, and all of it would count as
        # outliers: their squares lead to the end within a few steps, and their sizes do not.
        for is_robust, evaluations in ((False, FIRST_EVALUATIONS), (True, EVALUATIONS)):
            residual = problem.residual_at(vector)
            knee = find_knee(residual) if is_robust else _find_no_knee(residual)
            ended = descend(
                problem.residual_at,
                problem.jacobian_at,
                vector,
                problem.low,
                problem.high,
                knee=knee,
                tolerance=TOLERANCE,
                evaluations=evaluations,
            )
            vector = ended.vector
            hopeless = problem.is_hopeless(problem.residual_at(vector))
            if hopeless or ended.ending is not DescentEnd.EVALUATIONS:
                break
        if hopeless:
            break
    amount = float(vector[-1]) * suspect.scale
    fits = {}
    for (blocks, whole), fitted, plant in zip(
        touched.items(), problem.fits, problem.settings_at(vector), strict=True
    ):
        drives = tuple(suspect.apply(d, amount) for d in whole.drives)
        fits[blocks] = Fit(plant, fitted.free, drives, stack_residuals(drives, plant))
    half = problem.half_interval(vector) * suspect.scale
    return SuspectFit(base, suspect, amount, half, fits)


def _find_no_knee(residual: Array) -> float:
    return NEVER * (float(np.max(np.abs(residual))) or 1.0)


class _Problem:
    """The joint fit as the optimiser sees it: the numbers of each fit in turn, then the suspect.

    A number of the plant that is the suspect itself keeps the plant file's value.
    """

    def __init__(
        self,
        base: Model,
        suspect: Suspect,
        touched: Mapping[frozenset[str], Fit],
        settings: PlantSettings | None,
    ) -> None:
        self.suspect, self.step = suspect, STEP
        nominal = base.evidence.nominal
        held = {} if suspect.is_timed else {suspect.number}
        self.fits = [
            replace(
                f,
                settings=_hold(f.settings, nominal, held),
                free=tuple(n for n in f.free if n.name not in held),
                drives=coarsen(f.drives, f.settings, free=f.free),
            )
            for f in touched.values()
        ]
        self.weights = [weights_of(base, f) for f in self.fits]
        numbers = [f for fitted in self.fits for f in fitted.free]
        self.scale = np.array([f.scale for f in numbers] + [suspect.scale])
        self.low = np.array([f.low for f in numbers] + [suspect.low]) / self.scale
        self.high = np.array([f.high for f in numbers] + [suspect.high]) / self.scale
        # A number at its bound was pushed there by what the base lacks: it starts again.
        self.values = np.array(
            [
                value_of(nominal if n.name in f.at_bound else settings or f.settings, n.name)
                for f in self.fits
                for n in f.free
            ]
            + [0.0]
        )
        residual = np.concatenate(
            [w * f.residual for w, f in zip(self.weights, self.fits, strict=True)]
        )
        self.before = [float(r @ r) for r in self._split(residual)]
        self._last: list[tuple[Array, Array]] = []
        self._last_slope: tuple[tuple[float, bytes], Array] | None = None

    def _split(self, residual: Array) -> list[Array]:
        return np.split(residual, np.cumsum([len(w) for w in self.weights])[:-1])

    def is_hopeless(self, residual: Array) -> bool:
        """Tell whether hardly anything of any fit is explained."""
        parts = zip(self._split(residual), self.before, strict=True)
        return all(float(r @ r) > HOPELESS_SHARE * before for r, before in parts)

    def vector_at(self, amount: float) -> Array:
        """Return the start's numbers with an amount of the suspect, in scales."""
        values = self.values.copy()
        values[-1] = amount
        clipped: Array = np.clip(values / self.scale, self.low, self.high)
        return clipped

    def settings_at(self, vector: Array) -> list[PlantSettings]:
        """Return the plant of each fit."""
        values = np.clip(vector, self.low, self.high) * self.scale
        settings, place = [], 0
        for fitted in self.fits:
            names = [f.name for f in fitted.free]
            own = dict(zip(names, values[place : place + len(names)].tolist(), strict=True))
            settings.append(with_values(fitted.settings, own))
            place += len(names)
        return settings

    def residual_at(self, vector: Array) -> Array:
        """Return the weighted residuals of all fits, with half the steps where that does."""
        known = next((r for v, r in self._last if np.array_equal(v, vector)), None)
        if known is not None:
            return known
        amount = float(vector[-1]) * self.suspect.scale
        parts = []
        for fitted, weight, settings in zip(
            self.fits, self.weights, self.settings_at(vector), strict=True
        ):
            drives = [self.suspect.apply(d, amount) for d in fitted.drives]
            parts.append(weight * stack_residuals(drives, settings))
        residual: Array = np.concatenate(parts)
        self._last = [*self._last[-1:], (vector.copy(), residual)]
        return residual

    def jacobian_at(self, vector: Array) -> Array:
        """Return derivatives by all numbers in their scales; each fit answers its own only."""
        residual = self.residual_at(vector)
        key = (self.step, vector.tobytes())
        if self._last_slope is not None and self._last_slope[0] == key:
            return self._last_slope[1]
        step = 0.3 if vector[-1] + 0.3 < self.high[-1] else -0.3
        moved = vector.copy()
        moved[-1] += step
        slope = np.zeros((len(residual), len(vector)))
        slope[:, -1] = (self.residual_at(moved) - residual) / step
        amount = float(vector[-1]) * self.suspect.scale
        row = column = 0
        for fitted, weight, settings in zip(
            self.fits, self.weights, self.settings_at(vector), strict=True
        ):
            drives = [self.suspect.apply(d, amount) for d in fitted.drives]
            rows = slice(row, row + len(weight))
            own = sensitivity(drives, settings, fitted.free, self.step)
            slope[rows, column : column + own.shape[1]] = weight[:, None] * own
            row, column = row + len(weight), column + own.shape[1]
        self._last_slope = (key, slope)
        return slope

    def half_interval(self, vector: Array) -> float:
        """Return half the 90 % interval of the suspect, in scales, from scores over stretches."""
        slope, residual = self.jacobian_at(vector), self.residual_at(vector)
        bread = np.linalg.pinv(slope.T @ slope)
        length = max(int(STRETCH_S / float(np.median(self.fits[0].drives[0].step_s))), 1)
        filling = np.zeros_like(bread)
        for begin in range(0, len(residual), length):
            score = slope[begin : begin + length].T @ residual[begin : begin + length]
            filling += np.outer(score, score)
        variance = float((bread @ filling @ bread)[-1, -1])
        return 1.8 * float(np.sqrt(max(variance, 0.0)))


def _hold(settings: PlantSettings, nominal: PlantSettings, held: Collection[str]) -> PlantSettings:
    """Give numbers of the plant their values of the plant file; columns are not of the plant."""
    return with_values(
        settings, {name: value_of(nominal, name) for name in held if name in CONSTANTS}
    )


MUCH = 0.05
"""Margins below count as equal."""


def held_out_margins(
    one: Mapping[str, Array], other: Mapping[str, Array], base: Model, blocks: Sequence[str]
) -> tuple[float, float]:
    """Return low and high end of log(mean square of other / of one) over stretches, 96 %.

    A paired bootstrap: stretches of a quarter second are drawn again, each block in its floor.
    """
    pairs = [_pair_stretches(one[b], other[b], base, b) for b in blocks]
    a, b = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    random = np.random.default_rng(11)
    picks = random.integers(0, len(a), (400, len(a)))
    margins = np.log(b[picks].mean(axis=1) + 1e-30) - np.log(a[picks].mean(axis=1) + 1e-30)
    return float(np.quantile(margins, 0.02)), float(np.quantile(margins, 0.98))


def _pair_stretches(one: Array, other: Array, base: Model, block: str) -> tuple[Array, Array]:
    drive: Drive = base.evidence.holdout[block][0]
    length = max(int(0.25 / float(np.median(drive.step_s))), 1)
    floor = base.floors[block].mean

    def squares(residual: Array) -> Array:
        whole = residual[: len(residual) // length * length].reshape(-1, length)
        return np.asarray((whole**2).mean(axis=1)) / floor**2

    return squares(one), squares(other)
