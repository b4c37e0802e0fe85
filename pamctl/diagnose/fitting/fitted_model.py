"""A fitted model, recalibrated and with some effects; and what it leaves of the records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from pamctl.diagnose.fitting.block_fit import Fit, rms
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.drives import stack_residuals
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.floor import Floor, estimate_floor, sensor_noise_of, simulate_floor
from pamctl.diagnose.fitting.numbers import FreeNumber, look_up_parameter
from pamctl.diagnose.fitting.repeatability import RepeatSpread, measure_repeatability
from pamctl.diagnose.measured.record import Array

LEAST_SIZE = 0.5
"""An effect smaller than this share of the smallest size of interest is not named."""
FORM_SHARE = 0.01
"""Share of what an effect explains that may be left: no effect has exactly nature's form."""
FAR_ABOVE_LIMIT = 2.5
"""A block above this multiple of its limit is above any floor."""

_FLOORS: WeakKeyDictionary[Fit, dict[tuple[str, float], Floor]] = WeakKeyDictionary()
"""By fit, block and margin. Models share the fits of unchanged blocks, and with them the floors."""


@dataclass(frozen=True)
class Model:
    """Fits of all blocks with a set of effects.

    Blocks that share an effect are fitted together, the others separately.
    """

    evidence: Evidence
    effects: tuple[Candidate, ...]
    fits: Mapping[frozenset[str], Fit]
    """By the blocks that were fitted together."""
    is_joint: bool = False
    """All blocks were fitted together, with one geometry."""
    root: Model | None = None
    """The recalibrated model. Its floor serves quick fits, and blocks far above the floor."""
    is_final: bool = False
    """Its numbers were fitted to the end; then it has its own floor."""

    @property
    def names(self) -> tuple[str, ...]:
        """The effects' names."""
        return tuple(c.name for c in self.effects)

    def fit_of(self, block: str) -> Fit:
        """Return the fit that covers a block."""
        return next(fitted for blocks, fitted in self.fits.items() if block in blocks)

    @property
    def values(self) -> dict[str, float]:
        """Every fitted number; where the geometry of the blocks differs, the mechanics' counts."""
        ordered = sorted(self.evidence.blocks, reverse=True)
        return {name: value for b in ordered for name, value in self.fit_of(b).values.items()}

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Numbers at an end of their range."""
        return tuple(dict.fromkeys(n for fitted in self.fits.values() for n in fitted.at_bound))

    @property
    def effect_values(self) -> dict[str, float]:
        """The fitted numbers of the effects."""
        return {
            free.name: fitted.values[free.name]
            for fitted in self.fits.values()
            for free in fitted.free
            if free.effect
        }

    @cached_property
    def residuals(self) -> dict[str, Array]:
        """Held-out residuals of each block, in deviations of the sensor."""
        return {
            block: stack_residuals(self.evidence.holdout[block], self.fit_of(block).settings)
            for block in self.evidence.blocks
        }

    @cached_property
    def rms(self) -> dict[str, float]:
        """Held-out RMS of each block, in deviations of the sensor."""
        return {block: rms(residual) for block, residual in self.residuals.items()}

    @cached_property
    def floors(self) -> dict[str, Floor]:
        """What a perfect model leaves, by block."""
        return {block: self._find_floor(block) for block in self.evidence.blocks}

    def fit_for_floor(self, block: str) -> Fit:
        """Return the fit that makes the floor of a block."""
        root = self.root
        if root is None:
            return self.fit_of(block)
        is_own = self.is_final and self.rms[block] <= FAR_ABOVE_LIMIT * root.floors[block].limit
        return self.fit_of(block) if is_own else root.fit_of(block)

    def _find_floor(self, block: str) -> Floor:
        if self.root is not None and self.fit_for_floor(block) is self.root.fit_of(block):
            return self.root.floors[block]
        fitted = self.fit_of(block)
        holdout, margin = self.evidence.holdout[block], self.evidence.margin(block)
        known = _FLOORS.setdefault(fitted, {})
        key = (block, margin)
        if key not in known:
            known[key] = simulate_floor(fitted, holdout, self.evidence.noises, margin=margin)
        if sensor_noise_of(holdout, self.evidence.noises).is_known:
            return known[key].with_repeatability(self.repeatability[block])
        if self.root is not None:  # the recalibrated model's stretches serve all models
            return self.root.floors[block]
        return estimate_floor(
            known[key],
            self.residuals[block],
            holdout,
            self.repeatability[block],
            margin=margin,
            is_doubted=block in self.evidence.doubted,
        )

    @cached_property
    def repeatability(self) -> dict[str, RepeatSpread]:
        """How far the rig is from repeating itself, by block."""
        if self.root is not None:
            return self.root.repeatability
        evidence = self.evidence
        return {
            block: measure_repeatability(
                [*evidence.train[block], *evidence.holdout[block]],
                self.fit_of(block).settings,
                evidence.repeated,
            )
            for block in evidence.blocks
        }

    def ratio(self, block: str) -> float:
        """Return held-out RMS over the floor."""
        return self.rms[block] / self.floors[block].mean

    def is_explained(self, block: str) -> bool:
        """Tell whether a block is at or below its limit; effects may leave `FORM_SHARE` more."""
        before = self.root.rms[block] if self.root is not None and self.effects else 0.0
        return self.rms[block] <= float(np.hypot(self.floors[block].limit, FORM_SHARE * before))

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Blocks above their limits."""
        return tuple(b for b in self.evidence.blocks if not self.is_explained(b))

    @property
    def leaves_signal(self) -> bool:
        """Tell whether a block is above what noise alone leaves, be it below its limit."""
        return any(map(self.leaves_signal_of, self.evidence.blocks))

    def leaves_signal_of(self, block: str) -> bool:
        """Tell it of one block. Of an estimated floor nobody knows; repeats may differ by more."""
        floor = self.floors[block]
        noise = max(floor.highest_noise, floor.repeatability)
        return not floor.is_estimate and self.rms[block] > noise

    @property
    def is_complete(self) -> bool:
        """Tell whether every block is explained, with effects that are worth a name."""
        return not self.unexplained and (self.is_plausible or not self.effects)

    @property
    def is_plausible(self) -> bool:
        """Tell whether every effect is worth a name, and no number is at an end of its range."""
        return all(map(self.is_substantial, self.effects)) and not self.has_number_at_bound

    @property
    def has_number_at_bound(self) -> bool:
        """Tell whether a calibrated number or a size is at an end that nature did not set."""
        sizes = {s.name for c in self.effects for s in c.switches if not has_natural_end(s)}
        return any(name in sizes or "." not in name for name in self.at_bound)

    def is_substantial(self, effect: Candidate) -> bool:
        """Tell whether one of the effect's sizes is large enough for a name."""
        values = {n: v for fitted in self.fits.values() for n, v in fitted.values.items()}
        return any(
            abs(values[s.name] - look_up_parameter(s.name).neutral) >= LEAST_SIZE * s.scale
            for s in effect.switches
        )

    @cached_property
    def misfit(self) -> float:
        """What is left: the sum over blocks of log(RMS over limit), each at least zero."""
        return sum(
            max(float(np.log(self.rms[b] / self.floors[b].limit)), 0.0)
            for b in self.evidence.blocks
        )


def has_natural_end(number: FreeNumber) -> bool:
    """Tell whether nature ends the range of an effect's number (air is adiabatic at most)."""
    return look_up_parameter(number.name).has_natural_end


def extract_block_fit(fitted: Fit, block: str) -> Fit:
    """Return the part of a fit that belongs to one block."""
    rows = np.concatenate([np.full(d.samples, d.block == block) for d in fitted.drives])
    if rows.all():
        return fitted
    drives = tuple(d for d in fitted.drives if d.block == block)
    part = Fit(fitted.settings, fitted.free, drives, fitted.residual[rows])
    part.__dict__["jacobian"] = fitted.jacobian[rows]
    return part
