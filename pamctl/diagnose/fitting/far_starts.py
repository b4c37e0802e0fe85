"""Other starts for a fit that ended far from the data: a guess may be several times off.

A fit descends into the nearest valley. Where it leaves a large share of what moves, starts spread
over the ranges of the numbers are simulated once each, and the best few are fitted.

Where friction sticks, a free run slips too early or too late, and stays beside the data from there
on. What it leaves hardly depends on the numbers until nearly all of them are right. In short
windows that begin at the measured state each slip is judged alone, and the way to the numbers is
smooth.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from pydantic import ValidationError

from pamctl.diagnose.fitting.block_fit import (
    FULL,
    QUICK,
    Fit,
    fit_numbers,
    rms,
)
from pamctl.diagnose.fitting.drives import MECHANICS, RUNAWAY, Drive, stack_residuals
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import FreeNumber, with_values
from pamctl.diagnose.judging.windows import cut_windows
from pamctl.diagnose.measured.record import Array
from pamctl.plant.model import PlantSettings

FAR_SHARE = 0.1
"""A fit that leaves more than this share of what moves may be in a wrong valley."""
SPREAD = 1.5
"""Numbers whose range spans more than this factor are spread; the others keep their values."""
POWER = 4
"""2^4 starts are simulated."""
MOST_FITTED = 2
"""Starts that are fitted."""
WINDOW_S = 0.1
"""Length of a window; a slip takes about as long."""
FEWEST_SAMPLES = 20
"""Samples of a window, at least."""


def search_starts(fitted: Fit) -> Fit:
    """Return the fit, or a better one from another start where it ended far from the data."""
    spread = [f for f in fitted.free if 0.0 < f.low * SPREAD < f.high]
    if not spread or not is_far(fitted):
        return fitted
    from scipy.stats import qmc  # most of a second to import, and few fits need it

    low, high = (np.log([getattr(f, end) for f in spread]) for end in ("low", "high"))
    points = qmc.Sobol(len(spread), seed=3).random_base2(POWER)
    starts = [_name_values(spread, np.exp(low + p * (high - low))) for p in points]
    settings = [s for start in starts for s in _move_to(fitted.settings, start)]
    settings.sort(key=lambda s: _level_of(stack_residuals(fitted.drives, s)))
    tried = [fit_numbers(fitted.drives, s, fitted.free, QUICK) for s in settings[:MOST_FITTED]]
    best = min((fitted, *tried), key=lambda f: f.mean_square)
    if best is fitted:
        return fitted
    ended = fit_numbers(fitted.drives, best.settings, fitted.free, FULL)
    return min(best, ended, key=lambda f: f.mean_square)


def is_far(fitted: Fit) -> bool:
    """Tell whether a fit leaves a large share of what moves in its drives."""
    return rms(fitted.residual) > FAR_SHARE * rms(np.concatenate([*map(_movement, fitted.drives)]))


def _movement(drive: Drive) -> Array:
    """Return what a model without any motion leaves, in deviations of the sensor."""
    still = np.full(len(drive.measured), float(np.mean(drive.measured)))
    moved: Array = replace(drive, slack=0.0).residual_of(still)
    return moved


def _level_of(residual: Array) -> float:
    """Return the usual size of a residual; a model that runs away is the worst."""
    return float(np.median(np.abs(residual).clip(0.0, RUNAWAY)))


def _move_to(settings: PlantSettings, values: dict[str, float]) -> Iterator[PlantSettings]:
    """Yield the plant with these values; nothing where they exclude each other."""
    with suppress(ValidationError):
        yield with_values(settings, values)


def _name_values(free: list[FreeNumber], values: Array) -> dict[str, float]:
    return {f.name: float(v) for f, v in zip(free, values, strict=True)}


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
