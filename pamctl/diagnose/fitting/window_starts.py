"""A start that is found in windows, for a fit that friction holds in a valley.

Where friction sticks, a free run slips too early or too late, and stays beside the data from there
on. What it leaves hardly depends on the numbers until nearly all of them are right. In short
windows that begin at the measured state each slip is judged alone, and the way to the numbers is
smooth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pamctl.diagnose.fitting.block_fit import FULL, Fit, fit_numbers
from pamctl.diagnose.fitting.drives import MECHANICS, Drive
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.judging.windows import cut_windows

WINDOW_S = 0.1
"""Length of a window; a slip takes about as long."""
FEWEST_SAMPLES = 20
"""Samples of a window, at least."""


def fit_from_windows(model: Model) -> Model:
    """Return the model, or a better one whose fit of the mechanics starts where windows lead.

    Unchanged where the mechanics are judged in windows anyway, as an equation, or at their limit.
    """
    if MECHANICS not in model.unexplained:
        return model
    fits = {b: _start_in_windows(f) if MECHANICS in b else f for b, f in model.fits.items()}
    if all(found is model.fits[blocks] for blocks, found in fits.items()):
        return model
    return replace(model, fits=fits, is_final=True)


def _start_in_windows(fitted: Fit) -> Fit:
    cut = tuple(map(_cut_drive, fitted.drives))
    if all(one is other for one, other in zip(cut, fitted.drives, strict=True)):
        return fitted
    near = fit_numbers(cut, fitted.settings, fitted.free, FULL)
    ended = fit_numbers(fitted.drives, near.settings, fitted.free, FULL)
    return min(fitted, ended, key=lambda f: f.mean_square)


def _cut_drive(drive: Drive) -> Drive:
    """Return a free run of the mechanics in windows; any other drive as it is."""
    if drive.block != MECHANICS or drive.windows or drive.is_equation:
        return drive
    samples = max(round(WINDOW_S / float(np.median(drive.step_s))), FEWEST_SAMPLES)
    return replace(drive, windows=cut_windows([slice(0, len(drive.measured))], samples))
