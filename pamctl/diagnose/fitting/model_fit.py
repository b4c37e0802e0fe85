"""Fit a model's numbers: recalibration, a set of effects, all blocks with one geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from pamctl.diagnose.fitting.block_fit import FULL, QUICK, Effort, Fit, fit_numbers, rms
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, has_constant_volume
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.far_starts import search_starts
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import (
    SENSOR_ZERO,
    FreeNumber,
    active_effects,
    calibrated_number,
    calibration_of,
    numbers_of_start,
    sensor_zero,
    with_values,
)
from pamctl.diagnose.measured.record import Array
from pamctl.plant.catalogue import WITH_TERMS
from pamctl.plant.model import PlantSettings

FOREIGN_ZERO_PA = 5e3
"""Zero of a pressure sensor that nobody homed, beyond what homing leaves."""


def group_blocks(
    blocks: Sequence[str], effects: Sequence[Candidate], *, joint: bool
) -> tuple[frozenset[str], ...]:
    """Return which blocks are fitted together: all, if `joint` or if an effect reaches both."""
    shared = joint or any(len(c.blocks & set(blocks)) > 1 for c in effects)
    return (frozenset(blocks),) if shared else tuple(frozenset({b}) for b in blocks)


def list_free_numbers(
    blocks: frozenset[str], effects: Sequence[Candidate], evidence: Evidence
) -> tuple[FreeNumber, ...]:
    """Return the numbers that a fit of these blocks may move: calibration first, then effects.

    Without a measured position the pressure block simulates the mechanics too. Their numbers are
    then free as well.
    """
    nominal = evidence.nominal
    blind = any(not d.has_position for b in blocks for d in evidence.train[b])
    names = dict.fromkeys(
        n for b in (PRESSURE, MECHANICS) if b in blocks or blind for n in calibration_of(b, nominal)
    )
    own = [f for c in effects if c.blocks & blocks for f in c.free]
    zero = () if any(f.name == SENSOR_ZERO for f in own) else _list_zeros(nominal)
    return (
        *(calibrated_number(n, nominal, evidence.reach) for n in names),
        *zero,
        *numbers_of_start(nominal, {PRESSURE, MECHANICS} if blind else blocks, evidence.reach),
        *own,
    )


def _list_zeros(nominal: PlantSettings) -> tuple[FreeNumber, ...]:
    """Return the pressure sensor's zero: as homing leaves it, or wide on a rig without homing.

    The zero of a direct mechanism's force is its constant load, which is recalibrated.
    """
    if nominal.actuator == "direct" or SENSOR_ZERO in nominal.known:
        return ()
    zero = sensor_zero(nominal)
    if has_constant_volume(nominal):
        zero = replace(zero, low=zero.low - FOREIGN_ZERO_PA, high=zero.high + FOREIGN_ZERO_PA)
    return (zero,)


def recalibrate(evidence: Evidence, known: Mapping[frozenset[str], Fit] | None = None) -> Model:
    """Fit the start model's calibrated numbers, and no effect.

    `known` are earlier fits on the same drives. Where a force was measured, its balance gives a
    second start. A fit that misses much of what moves is repeated from starts all over the ranges.
    """
    starts = [{}, *([_fit_balance(evidence)] if evidence.balance else ())]
    model = fit_model(Model(evidence, (), {}), (), starts, effort=FULL, known=known or {})
    fits = {b: f if known and b in known else search_starts(f) for b, f in model.fits.items()}
    return replace(model, fits=fits)


def _fit_balance(evidence: Evidence) -> dict[str, float]:
    """Return the numbers that balance a measured force: nearly linear, so from any guess."""
    free = list_free_numbers(frozenset({MECHANICS}), (), evidence)
    return fit_numbers(evidence.balance, evidence.nominal, free, FULL).values


def weigh_blocks(base: Model) -> Model:
    """Return a recalibrated model whose joint fits weigh each block by its floor."""
    if len(base.evidence.blocks) < 2:
        return base
    evidence = base.evidence.weigh_by_floors(base.floors)
    return recalibrate(evidence) if base.is_joint else replace(base, evidence=evidence)


def fit_jointly(model: Model) -> Model:
    """Fit all blocks again, with one geometry.

    A block that is fitted alone may hide an effect in its own braid length. A model that is
    complete only block by block is not complete.
    """
    if model.is_joint or len(model.evidence.blocks) < 2:
        return model
    return fit_model(model, model.effects, [{}], joint=True, effort=FULL)


def fit_to_end(model: Model) -> Model:
    """Fit a model's numbers to the end."""
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
    """Fit a model with these effects; keep the best of several starts.

    Blocks that no changed effect reaches keep their fit from `base`.
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
        settings = _start_from_base(base, blocks, effects)
        tried: list[Fit] = []
        for start in starts:
            begin = _move_to_start(settings, free, effects, start)
            tried.append(fit_numbers(drives, begin, free, effort))
            if base.fits and reaches_limits(tried[-1], base):
                break  # another start cannot leave less than noise
        fits[blocks] = min(tried, key=lambda f: f.mean_square)
    root = base.root or (base if base.fits else None)
    return Model(evidence, tuple(effects), fits, joint, root, is_final=effort is FULL)


def reaches_limits(fitted: Fit, base: Model) -> bool:
    """Tell whether a fit leaves no more of any block than the floor's limit of the root model."""
    root, first = base.root or base, 0
    squares: dict[str, list[Array]] = {}
    for drive in fitted.drives:
        part = fitted.residual[first : first + drive.samples] * drive.deviation
        squares.setdefault(drive.block, []).append(part)
        first += drive.samples
    return all(
        rms(np.concatenate(parts))
        <= root.floors[block].limit * root.evidence.train[block][0].deviation
        for block, parts in squares.items()
    )


def _has_shared_effect(evidence: Evidence) -> bool:
    """Tell whether the start model has an effect that both blocks must agree on."""
    return any(
        len({*WITH_TERMS[name].seen_by} & {*evidence.blocks}) > 1
        for name in active_effects(evidence.nominal)
    )


def _start_from_base(
    base: Model, blocks: frozenset[str], effects: Sequence[Candidate]
) -> PlantSettings:
    """Return the base model's numbers, without the effects and the forms that were taken out.

    A number that the new form of an effect does not fit is not carried over: nobody would see it.
    """
    moved = {f.name for c in effects for f in c.free}
    values = {name: value for c in effects if c.blocks & blocks for name, value in c.held}
    for block in sorted(blocks, reverse=True):  # the mechanics decide the geometry
        if base.fits:
            fitted = base.fit_of(block)
            values |= {
                f.name: fitted.values[f.name]
                for f in fitted.free
                if f.effect is None or f.name in moved
            }
    return with_values(base.evidence.nominal, values)


def _move_to_start(
    settings: PlantSettings,
    free: Sequence[FreeNumber],
    effects: Sequence[Candidate],
    start: Mapping[str, float],
) -> PlantSettings:
    """Return the plant at a start; an effect's numbers bring the values that its form fixes."""
    names = {f.name for f in free}
    own = {f.effect for f in free if f.name in start}
    held = {n: v for c in effects if c.name in own for n, v in c.held}
    return with_values(settings, {**held, **{n: v for n, v in start.items() if n in names}})


def wrap_nominal_model(evidence: Evidence) -> Model:
    """Return the start model with nothing fitted."""
    fits = {
        frozenset({block}): fit_numbers(drives, evidence.nominal, ())
        for block, drives in evidence.train.items()
    }
    return Model(evidence, (), fits)
