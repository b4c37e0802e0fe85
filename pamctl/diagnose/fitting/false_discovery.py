"""Which of many comparisons stand out, when one in twenty of those said to may be mere noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import false_discovery_control
from scipy.stats import t as student

from pamctl.diagnose.measured.record import Array

RATE = 0.05
"""Of what is said to stand out, the share that noise alone may have brought, in the mean."""


def flag_discoveries(p_values: ArrayLike, rate: float = RATE) -> NDArray[np.bool_]:
    """Tell which comparisons stand out, by Benjamini and Hochberg's step-up.

    It holds for regimes that share samples as well, since these go up and down together.
    """
    p = np.asarray(p_values, dtype=np.float64)
    found: NDArray[np.bool_] = false_discovery_control(p) <= rate if len(p) else p > 0.0
    return found


def exceedance(level: float, replicas: Array, doubt: float = 0.0) -> float:
    """Return the chance that what made `replicas` would once more give a level as high.

    Levels are mean squares, whose logarithms are near normal: Student's t of the next draw.
    `doubt` is how well the scale of the replicas is known itself, one sigma, relative.
    """
    logs = np.log(replicas)
    scatter = float(np.hypot(logs.std(ddof=1) * np.sqrt(1.0 + 1.0 / len(logs)), doubt))
    if level <= 0.0 or scatter == 0.0:
        return float(level <= np.exp(logs.mean()))
    return float(student.sf((np.log(level) - logs.mean()) / scatter, len(logs) - 1))
