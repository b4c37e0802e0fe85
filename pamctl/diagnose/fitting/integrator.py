"""The integrator's error in a fit: what half the sub-step changes.

Fit and simulation use the same integrator, so that a fitted model behaves the same in both. The
error of the sub-step is then in the fitted numbers and in the self-simulated floor, and neither
shows it. A simulation with half the sub-step shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pamctl.diagnose.fitting.block_fit import Fit, fit_numbers, rms
from pamctl.diagnose.fitting.drives import Drive, stack_residuals
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.measured.record import Array

SMALL = 0.1
"""A change below this share of the floor does not matter."""
MUCH = 0.3
"""A change above this share of the floor is worth more steps."""
MOST_STEPS = 16
"""In a period. The error of a smooth motion falls to a quarter with each doubling."""
WHOLE = 2.0
"""An error in proportion to the sub-step is twice what its half changes."""


def refine_substeps(model: Model) -> Evidence:
    """Return the evidence with as many sub-steps as the fitted plant needs; the same if enough.

    A light mass on a stiff spring may move through a good part of its period between two samples.
    Where a doubling does not halve the change, as where friction sticks in another place, more of
    them would not help.
    """
    evidence = model.evidence
    for block in evidence.blocks:
        settings, floor = model.fit_of(block).settings, model.floors[block].mean
        drives = evidence.holdout[block]
        residual, before, doublings = model.residuals[block], float("inf"), 0
        while drives[0].steps << doublings < MOST_STEPS:
            finer = _refine(drives, doublings + 1)
            moved = stack_residuals(finer, settings)
            change, residual = rms(moved - residual), moved
            if change <= MUCH * floor or change > 0.5 * before:
                break
            before, doublings = change, doublings + 1
        if doublings:
            evidence = replace(
                evidence,
                train={**evidence.train, block: _refine(evidence.train[block], doublings)},
                holdout={**evidence.holdout, block: _refine(drives, doublings)},
                together={},
            )
    return evidence


def _refine(drives: Sequence[Drive], doublings: int) -> tuple[Drive, ...]:
    return tuple(replace(drive, steps=drive.steps << doublings) for drive in drives)


def find_substep_shift(fitted: Fit) -> Array:
    """Return how far the sub-step moved the fitted numbers, in their scales, shape (p,).

    Where half the sub-step changes much, one more fit is made: a muscle that sticks in another
    place is no change of first order.
    """
    drives = _refine(fitted.drives, 1)
    change = stack_residuals(drives, fitted.settings) - fitted.residual
    if rms(change) <= SMALL * rms(fitted.residual):
        moved: Array = -np.linalg.pinv(fitted.jacobian) @ change
        return WHOLE * moved
    fine = fit_numbers(drives, fitted.settings, fitted.free).values
    return WHOLE * np.array([(fine[f.name] - fitted.values[f.name]) / f.scale for f in fitted.free])


def compare_substeps(model: Model) -> dict[str, float]:
    """Return the change that half the sub-step makes on held-out data, RMS over floor, by block."""
    return {
        block: rms(
            stack_residuals(_refine(model.evidence.holdout[block], 1), model.fit_of(block).settings)
            - model.residuals[block]
        )
        / model.floors[block].mean
        for block in model.evidence.blocks
    }
