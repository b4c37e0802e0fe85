"""A model under trial: the paper's, recalibrated, with some effects; and how it does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from weakref import WeakKeyDictionary

import numpy as np

from pamctl.diagnose.fitting.block_fit import FULL, QUICK, Effort, Fit, fit_numbers, rms
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, stack_residuals
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.floor import Floor, simulate_floor
from pamctl.diagnose.fitting.numbers import (
    SENSOR_ZERO,
    FreeNumber,
    active_effects,
    calibrated_number,
    calibration_of,
    look_up_parameter,
    numbers_of_start,
    sensor_zero,
    with_values,
)
from pamctl.diagnose.fitting.repeatability import RepeatSpread, measure_repeatability
from pamctl.diagnose.measured.record import Array
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings

LEAST_SIZE = 0.5
"""Of the smallest size of interest: what is smaller is no name."""
FORM_SHARE = 0.01
FAR_ABOVE_LIMIT = 2.5
"""A block so many limits high is above any floor."""

_FLOORS: WeakKeyDictionary[Fit, dict[str, Floor]] = WeakKeyDictionary()
"""By fit and block: models share the fits of what they do not change, and with them the floors."""


@dataclass(frozen=True)
class Model:
    """Fits of all blocks with a set of effects.

    Blocks that share an effect are fitted together, the others each for itself.
    """

    evidence: Evidence
    effects: tuple[Candidate, ...]
    fits: Mapping[frozenset[str], Fit]
    """By the blocks that were fitted together."""
    is_joint: bool = False
    """All blocks were fitted together, with one geometry."""
    root: Model | None = None
    """The recalibrated model: its floor does for quick fits, and where a block is far above it."""
    is_final: bool = False
    """Its numbers were fitted to the end: then its floor is its own."""

    @property
    def names(self) -> tuple[str, ...]:
        """The effects' names."""
        return tuple(c.name for c in self.effects)

    def fit_of(self, block: str) -> Fit:
        """Return the fit that covers a block."""
        return next(fitted for blocks, fitted in self.fits.items() if block in blocks)

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
        """What a perfect model would leave, by block."""
        return {block: self._find_floor(block) for block in self.evidence.blocks}

    def fit_for_floor(self, block: str) -> Fit:
        """Return the fit whose own data a block is held against."""
        root = self.root
        if root is None:
            return self.fit_of(block)
        is_own = self.is_final and self.rms[block] <= FAR_ABOVE_LIMIT * root.floors[block].limit
        return self.fit_of(block) if is_own else root.fit_of(block)

    def _find_floor(self, block: str) -> Floor:
        if self.root is not None and self.fit_for_floor(block) is self.root.fit_of(block):
            return self.root.floors[block]
        fitted = self.fit_of(block)
        known = _FLOORS.setdefault(fitted, {})
        if block not in known:
            holdout, margin = self.evidence.holdout[block], self.evidence.margin(block)
            known[block] = simulate_floor(fitted, holdout, self.evidence.noises, margin=margin)
        return known[block].with_repeatability(self.repeatability[block])

    @cached_property
    def repeatability(self) -> dict[str, RepeatSpread]:
        """By how much the rig does not repeat itself, by block."""
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
        """Tell whether nothing is left of a block above its limit.

        Of what an effect has explained, a hundredth may be left: nature's form is never quite ours.
        """
        before = self.root.rms[block] if self.root is not None and self.effects else 0.0
        return self.rms[block] <= float(np.hypot(self.floors[block].limit, FORM_SHARE * before))

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Blocks above their limits."""
        return tuple(b for b in self.evidence.blocks if not self.is_explained(b))

    @property
    def is_complete(self) -> bool:
        """Tell whether every block is at its floor, by effects that are worth a name."""
        return not self.unexplained and (self.is_plausible or not self.effects)

    @property
    def is_plausible(self) -> bool:
        """Tell whether every effect is worth a name, and no number stands at its range's end."""
        return all(map(self._is_substantial, self.effects)) and not self.has_number_at_bound

    @property
    def has_number_at_bound(self) -> bool:
        """Tell whether a calibrated number or a size stands at an end of its range."""
        sizes = {s.name for c in self.effects for s in c.switches}
        bound = {name for fitted in self.fits.values() for name in fitted.at_bound}
        return any(name in sizes or "." not in name for name in bound)

    def _is_substantial(self, effect: Candidate) -> bool:
        """Tell whether one of an effect's sizes is not far below the smallest of interest."""
        values = {n: v for fitted in self.fits.values() for n, v in fitted.values.items()}
        return any(
            abs(values[s.name] - look_up_parameter(s).neutral) >= LEAST_SIZE * s.scale
            for s in effect.switches
        )

    @cached_property
    def misfit(self) -> float:
        """Sum over blocks of the log of RMS over limit, none below zero: what is left, in nats."""
        return sum(
            max(float(np.log(self.rms[b] / self.floors[b].limit)), 0.0)
            for b in self.evidence.blocks
        )


def extract_block_fit(fitted: Fit, block: str) -> Fit:
    """Return one block's share of a fit."""
    rows = np.concatenate([np.full(d.samples, d.block == block) for d in fitted.drives])
    if rows.all():
        return fitted
    drives = tuple(d for d in fitted.drives if d.block == block)
    part = Fit(fitted.settings, fitted.free, drives, fitted.residual[rows])
    part.__dict__["jacobian"] = fitted.jacobian[rows]
    return part


def group_blocks(
    blocks: Sequence[str], effects: Sequence[Candidate], *, joint: bool
) -> tuple[frozenset[str], ...]:
    """Return which blocks must be fitted together, because an effect reaches both."""
    shared = joint or any(len(c.blocks & set(blocks)) > 1 for c in effects)
    return (frozenset(blocks),) if shared else tuple(frozenset({b}) for b in blocks)


def list_free_numbers(
    blocks: frozenset[str], effects: Sequence[Candidate], evidence: Evidence
) -> tuple[FreeNumber, ...]:
    """Return what a fit of these blocks may move: calibration first, then the effects'.

    Where no position was measured the mechanics move with the pressure block, and its numbers
    are free too.
    """
    nominal = evidence.nominal
    blind = any(not d.has_position for b in blocks for d in evidence.train[b])
    names = dict.fromkeys(
        n for b in (PRESSURE, MECHANICS) if b in blocks or blind for n in calibration_of(b, nominal)
    )
    own = [f for c in effects if c.blocks & blocks for f in c.free]
    has_zero = nominal.actuator == "muscle" and all(f.name != SENSOR_ZERO for f in own)
    zero = (sensor_zero(nominal),) if has_zero else ()
    return (
        *(calibrated_number(n, nominal) for n in names),
        *zero,
        *numbers_of_start(nominal, {PRESSURE, MECHANICS} if blind else blocks),
        *own,
    )


def recalibrate(evidence: Evidence, known: Mapping[frozenset[str], Fit] | None = None) -> Model:
    """Fit the start model's calibrated numbers, and no effect.

    `known` are fits that were made before on the same drives.
    """
    return fit_model(Model(evidence, (), {}), (), [{}], effort=FULL, known=known or {})


def weigh_blocks(base: Model) -> Model:
    """Return a recalibrated model whose fits of both blocks weigh each by its floor."""
    if len(base.evidence.blocks) < 2:
        return base
    evidence = base.evidence.weigh_by_floors(base.floors)
    return recalibrate(evidence) if base.is_joint else replace(base, evidence=evidence)


def fit_jointly(model: Model) -> Model:
    """Fit all blocks anew with the geometry that they share.

    Each block for itself may hide an effect in its own length of braid: what is complete
    in parts only is not complete.
    """
    if model.is_joint or len(model.evidence.blocks) < 2:
        return model
    return fit_model(model, model.effects, [{}], joint=True, effort=FULL)


def fit_to_end(model: Model) -> Model:
    """Fit a model's numbers to the end; what no effect reaches stays."""
    fits = {
        blocks: fit_numbers(f.drives, f.settings, f.free, FULL) for blocks, f in model.fits.items()
    }
    return Model(model.evidence, model.effects, fits, model.is_joint, model.root, is_final=True)


def fit_model(
    base: Model,
    effects: Sequence[Candidate],
    starts: Sequence[Mapping[str, float]],
    *,
    joint: bool = False,
    effort: Effort = QUICK,
    known: Mapping[frozenset[str], Fit] = MappingProxyType({}),
) -> Model:
    """Fit a model with these effects; the best of several starts.

    Blocks that no change of effects reaches keep the fit that `base` has.
    """
    evidence = base.evidence
    joint = joint or base.is_joint or _has_shared_effect(evidence)
    reached = {b for c in {*effects} ^ {*base.effects} for b in c.blocks}
    kept = {**known, **{b: f for b, f in base.fits.items() if not b & reached}}
    fits: dict[frozenset[str], Fit] = {}
    for blocks in group_blocks(evidence.blocks, effects, joint=joint):
        if blocks in kept:
            fits[blocks] = kept[blocks]
            continue
        drives = evidence.training_drives(blocks)
        free = list_free_numbers(blocks, effects, evidence)
        begun = _start_from_base(base, blocks, effects)
        tried = [
            fit_numbers(drives, _move_to_start(begun, free, effects, s), free, effort)
            for s in starts
        ]
        fits[blocks] = min(tried, key=lambda f: f.mean_square)
    root = base.root or (base if base.fits else None)
    return Model(evidence, tuple(effects), fits, joint, root, is_final=effort is FULL)


def _has_shared_effect(evidence: Evidence) -> bool:
    """Tell whether the start model has an effect that both blocks must agree on."""
    return any(
        len({*CATALOGUE[name].seen_by} & {*evidence.blocks}) > 1
        for name in active_effects(evidence.nominal)
    )


def _start_from_base(
    base: Model, blocks: frozenset[str], effects: Sequence[Candidate]
) -> PlantSettings:
    """Start from the base model's numbers, without the effects that are gone."""
    kept = {c.name for c in effects}
    values = {name: value for c in effects if c.blocks & blocks for name, value in c.held}
    for block in sorted(blocks, reverse=True):  # the geometry is the mechanics' to tell
        if base.fits:
            fitted = base.fit_of(block)
            values |= {
                f.name: fitted.values[f.name]
                for f in fitted.free
                if f.effect is None or f.effect in kept
            }
    return with_values(base.evidence.nominal, values)


def _move_to_start(
    begun: PlantSettings,
    free: Sequence[FreeNumber],
    effects: Sequence[Candidate],
    start: Mapping[str, float],
) -> PlantSettings:
    """Move to a start; what the form of an effect holds goes with its numbers."""
    names = {f.name for f in free}
    own = {f.effect for f in free if f.name in start}
    held = {n: v for c in effects if c.name in own for n, v in c.held}
    return with_values(begun, {**held, **{n: v for n, v in start.items() if n in names}})


def wrap_nominal_model(evidence: Evidence) -> Model:
    """Return the start model with nothing fitted."""
    fits = {
        frozenset({block}): fit_numbers(drives, evidence.nominal, ())
        for block, drives in evidence.train.items()
    }
    return Model(evidence, (), fits)
