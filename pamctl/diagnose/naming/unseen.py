"""Numbers of a mechanism that no record shows: they stay as the plant file has them.

Where motion is imposed, a mass may be anything that is light enough. A fit takes it to the end of
its range, which is a share of the guess. A plant file with that number would be a smaller guess,
and each diagnosis would end lower than the one before.
"""

from __future__ import annotations

from dataclasses import replace

from pamctl.diagnose.fitting.block_fit import FULL, Fit, fit_numbers, is_logarithmic
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import calibration_of, value_of, with_values
from pamctl.diagnose.naming.stretches import gains_in_block


def hold_unseen_numbers(model: Model) -> Model:
    """Return the model without the freedom of numbers that end at an end and gain nothing there.

    Only numbers whose range spans decades are asked: the others are known to a few per cent.
    """
    for blocks, fitted in model.fits.items():
        for free in fitted.free:
            if free.name in fitted.at_bound and is_logarithmic(free):
                held = _hold(model, fitted, free.name)
                candidate = replace(model, fits={**model.fits, blocks: held})
                if not any(gains_in_block(candidate, model, block) for block in blocks):
                    return hold_unseen_numbers(candidate)
    return model


def list_unseen(model: Model) -> tuple[str, ...]:
    """Return the numbers that are recalibrated in general, and that this model holds."""
    evidence = model.evidence
    names = (n for block in evidence.blocks for n in calibration_of(block, evidence.nominal))
    return tuple(dict.fromkeys(n for n in names if n not in model.values))


def _hold(model: Model, fitted: Fit, name: str) -> Fit:
    settings = with_values(fitted.settings, {name: value_of(model.evidence.nominal, name)})
    free = tuple(number for number in fitted.free if number.name != name)
    return fit_numbers(fitted.drives, settings, free, FULL)
