"""A ratio to the floor says little to the hand: the same RMS in the sensor's unit beside it."""

from __future__ import annotations

from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.report.compared_models import SIGNAL_DISPLAYS


def write_ratio(model: Model, block: str, ratio: float) -> str:
    """Write a residual over the floor with its RMS: `12.30 (4.1 kPa)`."""
    return f"{ratio:.2f} ({write_rms(model, block, ratio)})"


def write_rms(model: Model, block: str, ratio: float) -> str:
    """Write the RMS of a residual that is this multiple of the block's floor."""
    return write_deviations(model, block, ratio * model.floors[block].mean)


def write_deviations(model: Model, block: str, deviations: float) -> str:
    """Write an RMS that is given in deviations of the block's sensor."""
    drive = model.evidence.holdout[block][0]
    display = SIGNAL_DISPLAYS[drive.channel]
    rms = deviations * drive.deviation
    factor, unit = display.choose_unit(rms)
    return f"{factor * rms:.3g} {unit}"
