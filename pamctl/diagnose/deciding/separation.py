"""By how much a program separates explanations: what the wrong one would leave of its run.

One explanation is simulated as if it were true, and the other is fitted to what the sensors would
show. The fit may move all its numbers, at the price of what they explain of the records so far: one
Gauss-Newton step on both together. What is left, over the floor, is what a diagnosis would see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, permutations
from math import hypot

import numpy as np

from pamctl.control.excitation import ProgramSettings
from pamctl.diagnose.deciding.drawn_programs import sample_commands
from pamctl.diagnose.deciding.explanations import Explanation
from pamctl.diagnose.fitting.block_fit import Fit, rms, sensitivity
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, SMOOTH_HZ, Drive
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.measured.record import Array
from pamctl.plant.drive import CoupledResponse, SampleGrid, build_grid, drive_coupled
from pamctl.plant.model import plant_parameters

SMALL = 1e-9


@dataclass(frozen=True)
class Separation:
    """What one explanation leaves of a run where another is true."""

    true: str
    refuted: str
    block: str
    """The block that shows it best."""
    residual_over_floor: float
    """1 where the run does not separate the two."""


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
    def rough(self) -> float:
        """The least difference of two explanations' signals over the floor, with nothing refitted.

        It costs one simulation an explanation, and sorts the programs before the dearer figure.
        """
        return min(self._compare_roughly(a, b) for a, b in combinations(self.explanations, 2))

    def _compare_roughly(self, a: Explanation, b: Explanation) -> float:
        one, other = self.runs[a.name], self.runs[b.name]
        differences = {
            PRESSURE: one.pressure_pa - other.pressure_pa,
            MECHANICS: one.position_m - other.position_m,
        }
        return max(
            rms(differences[block]) / (_deviation_of(a.model, block) * a.model.floors[block].mean)
            for block in find_disputed_blocks(a.model, b.model)
        )

    @cached_property
    def separations(self) -> tuple[Separation, ...]:
        """Every explanation against every other that were true."""
        return tuple(self._separate(*order) for order in permutations(self.explanations, 2))

    def _separate(self, true: Explanation, other: Explanation) -> Separation:
        left: dict[str, float] = {}
        for blocks, fitted in other.model.fits.items():
            left |= self._fit_wrong_one(true, other, blocks, fitted)
        disputed = find_disputed_blocks(true.model, other.model)
        block = max(disputed, key=lambda b: left[b])
        return Separation(true.name, other.name, block, hypot(1.0, left[block]))

    def _fit_wrong_one(
        self, true: Explanation, other: Explanation, blocks: frozenset[str], fitted: Fit
    ) -> dict[str, float]:
        """Return what is left of each block after the refit, over its floor."""
        drives = self._prepare_drives(true, blocks, fitted)
        wrong = [d.residual(fitted.settings) for d in drives]
        right = [d.residual(true.model.fit_of(d.block).settings) for d in drives]
        change = np.concatenate(wrong) - np.concatenate(right)
        slope = self._find_slope(other, blocks, fitted)
        known = fitted.jacobian.T @ fitted.jacobian
        both = known + slope.T @ slope + SMALL * np.diag(np.diag(known))
        step = np.linalg.pinv(both, hermitian=True) @ (slope.T @ change)
        rest, ends = change - slope @ step, np.cumsum([d.samples for d in drives])[:-1]
        floors = other.model.floors
        return {
            d.block: rms(part) * d.deviation / _deviation_of(other.model, d.block)
            / floors[d.block].mean
            for d, part in zip(drives, np.split(rest, ends), strict=True)
        }  # fmt: skip

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

    def name_pairs(self) -> Mapping[frozenset[str], float]:
        """Return the lesser of both directions by pair."""
        pairs: dict[frozenset[str], float] = {}
        for s in self.separations:
            key = frozenset({s.true, s.refuted})
            pairs[key] = min(pairs.get(key, np.inf), s.residual_over_floor)
        return pairs


def find_disputed_blocks(one: Model, other: Model) -> list[str]:
    """Return the blocks that an effect reaches which only one of two models has.

    In the others the models differ by numbers only, which the next records may move. Models that
    differ by numbers alone dispute about all blocks.
    """
    reached = {b for c in {*one.effects} ^ {*other.effects} for b in c.blocks}
    return [b for b in one.evidence.blocks if b in reached] or [*one.evidence.blocks]


def _deviation_of(model: Model, block: str) -> float:
    return model.evidence.train[block][0].deviation
