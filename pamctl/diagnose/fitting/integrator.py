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
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.measured.record import Array

SMALL = 0.1
"""A change below this share of the floor does not matter."""
WHOLE = 2.0
"""An error in proportion to the sub-step is twice what its half changes."""


def halve_substep(drives: Sequence[Drive]) -> tuple[Drive, ...]:
    """Return the drives with half the sub-step."""
    return tuple(replace(drive, steps=2 * drive.steps) for drive in drives)


def find_substep_shift(fitted: Fit) -> Array:
    """Return how far the sub-step moved the fitted numbers, in their scales, shape (p,).

    Where half the sub-step changes much, one more fit is made: a muscle that sticks in another
    place is no change of first order.
    """
    drives = halve_substep(fitted.drives)
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
            stack_residuals(
                halve_substep(model.evidence.holdout[block]), model.fit_of(block).settings
            )
            - model.residuals[block]
        )
        / model.floors[block].mean
        for block in model.evidence.blocks
    }
