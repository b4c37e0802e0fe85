"""By how much a program separates explanations: what the wrong one would leave of its run.

One explanation is simulated as if it were true, and the other is fitted to what the sensors would
show. The fit may move all its numbers, at the price of what they explain of the records so far: one
Gauss-Newton step on both together. What is left, over the floor, is what a diagnosis would see.
A straight step does not follow a fit that goes far. So a forecast is made of whole fits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, permutations
from math import hypot

import numpy as np
from scipy.ndimage import uniform_filter1d

from pamctl.control.excitation import ProgramSettings
from pamctl.diagnose.deciding.drawn_programs import sample_commands
from pamctl.diagnose.deciding.explanations import Explanation
from pamctl.diagnose.fitting.block_fit import Effort, Fit, fit_numbers, rms, sensitivity
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, SMOOTH_HZ, Drive
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.diagnose.fitting.split import Part, find_samples
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.stretches import (
    MUCH,
    average_squares,
    average_squares_over_floor,
    find_sure_difference,
)
from pamctl.plant.drive import CoupledResponse, SampleGrid, build_grid, drive_coupled
from pamctl.plant.flat import NEUTRAL
from pamctl.plant.model import plant_parameters
from pamctl.plant.terms.locations import TERMS

SMALL = 1e-9
FORECAST = Effort(15, 1e-3, updates=2, most_rounds=3)
"""For a wrong explanation's refit: its end moves what is left by half a per cent."""
FAR = 3.0
"""A fit that leaves more, in deviations of the sensor, is begun once more from another start."""
SLOW_S = 0.1
"""Differences that last longer are what a refit of gains and rates takes away."""

_Refit = Callable[["Explanation", "Explanation", Fit, Sequence[Drive]], list[Array]]
"""It fits the second explanation where the first is true; what is left of each drive."""


@dataclass(frozen=True)
class Separation:
    """What one explanation leaves of a run where another is true."""

    true: str
    refuted: str
    block: str
    """The block that shows it best."""
    residual_over_floor: float
    """1 where the run does not separate the two."""
    sureness: float
    """Above 1, the rule that judges rivals would refute it, by this run and the records so far."""

    @property
    def is_decided(self) -> bool:
        """Whether the wrong one would be refuted."""
        return self.sureness > 1.0


class ProgramTrial:
    """One program, simulated under every explanation."""

    def __init__(
        self, program: ProgramSettings, explanations: Sequence[Explanation], period_s: float
    ) -> None:
        """Simulate the coupled plant of each explanation."""
        self.program, self.explanations, self.period_s = program, tuple(explanations), period_s
        self.commands_v = sample_commands(program, period_s)
        self.runs: dict[str, CoupledResponse] = {
            e.name: drive_coupled(plant_parameters(e.plant), self.commands_v, self.grid)
            for e in explanations
        }
        self._slopes: dict[tuple[str, frozenset[str]], Array] = {}

    @property
    def duration_s(self) -> float:
        """The length of the program."""
        return len(self.commands_v) * self.period_s

    @cached_property
    def grid(self) -> SampleGrid:
        """The simulation's steps."""
        samples = len(self.commands_v)
        return build_grid(np.full(samples - 1, self.period_s), samples)

    @cached_property
    def rough(self) -> tuple[float, float]:
        """The least difference of two explanations' signals over the floor, with nothing refitted.

        First all of it, then its fast part: a refit takes the slow part away first. They cost one
        simulation an explanation, and sort the programs before the dearer figure.
        """
        pairs = [self._compare_roughly(*pair) for pair in combinations(self.explanations, 2)]
        return min(whole for whole, _ in pairs), min(fast for _, fast in pairs)

    def _compare_roughly(self, a: Explanation, b: Explanation) -> tuple[float, float]:
        one, other = self.runs[a.name], self.runs[b.name]
        differences = {
            PRESSURE: one.pressure_pa - other.pressure_pa,
            MECHANICS: one.position_m - other.position_m,
        }
        disputed = {
            block: differences[block] / _floor_of(a.model, block)
            for block in find_disputed_blocks(a.model, b.model)
        }
        size = max(1, round(SLOW_S / self.period_s))
        fast = (d - uniform_filter1d(d, size) for d in disputed.values())
        return max(map(rms, disputed.values())), max(map(rms, fast))

    @cached_property
    def separations(self) -> tuple[Separation, ...]:
        """Every explanation against every other that were true; refitted by one straight step."""
        return self._separate_all(self._step_wrong_one)

    @cached_property
    def forecasts(self) -> tuple[Separation, ...]:
        """The same, by whole fits: dearer, and right also where the numbers go far."""
        return self._separate_all(self._fit_wrong_one)

    def _separate_all(self, refit: _Refit) -> tuple[Separation, ...]:
        return tuple(self._separate(*o, refit) for o in permutations(self.explanations, 2))

    def _separate(self, true: Explanation, other: Explanation, refit: _Refit) -> Separation:
        disputed = find_disputed_blocks(true.model, other.model)
        left: dict[str, Array] = {}
        for blocks, fitted in other.model.fits.items():
            if blocks.isdisjoint(disputed):
                continue
            drives = self._prepare_drives(true, blocks, fitted)
            rests = refit(true, other, fitted, drives)
            left |= {
                d.block: rest * d.deviation / _floor_of(other.model, d.block)
                for d, rest in zip(drives, rests, strict=True)
                if d.block in disputed
            }
        block = max(disputed, key=lambda b: rms(left[b]))
        over_floor = hypot(1.0, rms(left[block]))
        choosing = find_samples(drives[0], Part.CHOOSE, is_cut=True)
        seen = {b: left[b][choosing] for b in disputed}
        sureness = self._find_sureness(true.model, other.model, seen)
        return Separation(true.name, other.name, block, over_floor, sureness)

    def _step_wrong_one(
        self, true: Explanation, other: Explanation, fitted: Fit, drives: Sequence[Drive]
    ) -> list[Array]:
        """Return what is left of each drive after one Gauss-Newton step."""
        wrong = [d.residual(fitted.settings) for d in drives]
        right = [d.residual(true.model.fit_of(d.block).settings) for d in drives]
        change = np.concatenate(wrong) - np.concatenate(right)
        slope = self._find_slope(other, frozenset(d.block for d in drives), fitted)
        known = fitted.jacobian.T @ fitted.jacobian
        both = known + slope.T @ slope + SMALL * np.diag(np.diag(known))
        step = np.linalg.pinv(both, hermitian=True) @ (slope.T @ change)
        ends = np.cumsum([d.samples for d in drives])[:-1]
        return np.split(change - slope @ step, ends)

    def _fit_wrong_one(
        self, true: Explanation, other: Explanation, fitted: Fit, drives: Sequence[Drive]
    ) -> list[Array]:
        """Return what is left of each drive after a whole fit to it and the records so far."""
        # A term of size 0 would be no term: its place and form would be lost.
        effects = [f.name for f in fitted.free if f.effect and f.effect not in TERMS]
        neutral = {name: NEUTRAL[name] for name in effects}
        both = (*fitted.drives, *drives)
        again = fit_numbers(both, fitted.settings, fitted.free, FORECAST)
        if neutral and again.mean_square > FAR**2:  # a far fit may be stuck: begin without effects
            start = with_values(fitted.settings, neutral)
            other_way = fit_numbers(both, start, fitted.free, FORECAST)
            again = min(again, other_way, key=lambda fit: fit.mean_square)
        return [d.residual(again.settings) for d in drives]

    def _find_sureness(self, true: Model, wrong: Model, left: Mapping[str, Array]) -> float:
        """Return how surely the wrong one would be refuted, over what its judge asks.

        `left` is what it leaves of the samples that choose, over the floor.
        """
        new = np.concatenate([average_squares(rest, self.period_s) for rest in left.values()])
        less, more = (average_squares_over_floor(m, [*left]) for m in (true, wrong))
        return find_sure_difference(np.r_[less, np.ones(len(new))], np.r_[more, 1.0 + new]) / MUCH

    def _find_slope(self, other: Explanation, blocks: frozenset[str], fitted: Fit) -> Array:
        """Return the derivatives of an explanation's own run; they serve for every truth."""
        key = (other.name, blocks)
        if key not in self._slopes:
            drives = self._prepare_drives(other, blocks, fitted)
            self._slopes[key] = sensitivity(drives, fitted.settings, fitted.free)
        return self._slopes[key]

    def _prepare_drives(
        self, true: Explanation, blocks: frozenset[str], fitted: Fit
    ) -> tuple[Drive, ...]:
        """Return the drives that a log of this program would give, without noise."""
        run = self.runs[true.name]
        signals = {
            PRESSURE: (run.position_m, run.pressure_pa),
            MECHANICS: (run.pressure_pa, run.position_m),
        }
        step_s = np.full(len(self.commands_v) - 1, self.period_s)
        drives = []
        for block in sorted(blocks, reverse=True):
            like = next(d for d in fitted.drives if d.block == block)
            driven, measured = signals[block]
            is_pressure = block == PRESSURE
            atmosphere_pa = fitted.settings.parameters.atmospheric_pressure_pa
            drives.append(
                Drive(
                    block,
                    "program",
                    step_s,
                    self.commands_v if is_pressure else np.zeros(len(self.commands_v)),
                    driven,
                    0.0 if is_pressure else SMOOTH_HZ,
                    measured,
                    like.deviation,
                    like.slack,
                    atmosphere_pa if is_pressure else 0.0,
                    like.steps,
                )
            )
        return tuple(drives)


def find_pairs(separations: Sequence[Separation]) -> dict[frozenset[str], float]:
    """Return by pair how surely the wrong one would be refuted, whichever is the true one."""
    pairs: dict[frozenset[str], float] = {}
    for s in separations:
        key = frozenset({s.true, s.refuted})
        pairs[key] = min(s.sureness, pairs.get(key, np.inf))
    return pairs


def find_disputed_blocks(one: Model, other: Model) -> list[str]:
    """Return the blocks that an effect reaches which only one of two models has.

    In the others the models differ by numbers only, which the next records may move. Models that
    differ by numbers alone dispute about all blocks.
    """
    reached = {b for c in {*one.effects} ^ {*other.effects} for b in c.blocks}
    return [b for b in one.evidence.blocks if b in reached] or [*one.evidence.blocks]


def _floor_of(model: Model, block: str) -> float:
    """Return the floor of a block in SI."""
    return model.evidence.train[block][0].deviation * model.floors[block].mean
