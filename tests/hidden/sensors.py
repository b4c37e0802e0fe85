"""How a hidden rig is read: noise, steps, and a clock that is a little late."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

ENCODER_STEP_M = 25.4e-3 / 8000.0
ADC_STEP_PA = 47.5
AO_STEP_V = 20.0 / 65536.0


@dataclass(frozen=True)
class Sensors:
    """How a rig is read. Noise is the standard deviation of one reading."""

    pressure_noise_pa: float = 300.0
    coloured_share: float = 0.3
    """Of the noise variance: correlated over about 4 ms, as of a pipe or a supply."""
    pressure_gain: float = 1.0
    pressure_offset_pa: float = 0.0
    encoder_scale: float = 1.0
    encoder_phase: float = 0.5
    """Where within a count the encoder stood when it was homed."""
    encoder_homed: bool = True
    """Its zero is where the rig rested; otherwise it has an index and knows the true zero."""
    force_noise_n: float = 0.05
    clock_jitter_s: float = 12e-6
    missed_ticks: int = 0
    perfect: bool = False
    """Neither noise nor steps nor jitter: for tests of the truth."""


def remember(keep: float, first: float, kicks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return noise that keeps a share of its last value, from `first` on in place of a kick."""
    return np.asarray(lfilter([1.0], [1.0, -keep], np.concatenate([[first], kicks[1:]])))
