"""How sure a fitted number is, honestly under residuals that remember.

The Gauss-Newton covariance counts every sample as news; residuals of a second are much the
same news. So their scores are summed over seconds first (a sandwich), and the scatter and
the bias that the self-simulated replicas show are added: friction rectifies noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.fit import Fit
from pamctl.diagnose.floor import Floor
from pamctl.diagnose.records import Array
from pamctl.diagnose.values import unit_of

STRETCH_S = 1.0
NINETY = 1.645


@dataclass(frozen=True)
class Estimate:
    """A fitted number with its 90 % interval."""

    name: str
    value: float
    low: float
    high: float
    unit: str

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        return {"value": self.value, "ci90": [self.low, self.high], "unit": self.unit}


def estimates(fitted: Fit, floors: list[Floor]) -> dict[str, Estimate]:
    """Return every free number of a fit with its interval, within its range."""
    if not fitted.free:
        return {}
    sandwich = _sandwich(fitted)
    found = {}
    for index, number in enumerate(fitted.free):
        if number.is_nuisance:
            continue
        variance = sandwich[index, index]
        for floor in floors:
            if floor.shifts.shape[1] == len(fitted.free):
                shifts = floor.shifts[:, index]
                variance = max(variance, float(shifts.var(ddof=1))) + float(shifts.mean()) ** 2
        half = NINETY * number.scale * float(np.sqrt(variance))
        value = fitted.values[number.name]
        found[number.name] = Estimate(
            number.name,
            value,
            max(value - half, number.low),
            min(value + half, number.high),
            unit_of(number),
        )
    return found


def _sandwich(fitted: Fit) -> Array:
    """Covariance of the numbers in their scales, shape (p, p)."""
    slope, residual = fitted.jacobian, fitted.residual
    bread = np.linalg.pinv(slope.T @ slope)
    filling = np.zeros_like(bread)
    pieces = 0
    start = 0
    for drive in fitted.drives:
        end = start + drive.samples
        length = max(int(STRETCH_S / float(np.median(drive.step_s))), 1)
        for begin in range(start, end, length):
            stop = min(begin + length, end)
            score = slope[begin:stop].T @ residual[begin:stop]
            filling += np.outer(score, score)
            pieces += 1
        start = end
    spare = max(pieces - slope.shape[1], 1)
    covariance: Array = bread @ filling @ bread * (pieces / spare)
    return covariance
