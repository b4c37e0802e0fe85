"""The ball screw moves as its equation says, and its numbers come back from what it shows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

from hidden.ball_screw_drive import (
    BallScrewCase,
    ball_screw_cases,
)
from pamctl.plant.model import values_of
from pamctl.plant.parameters import parameters_of
from pamctl.plant.required_force import required_force_n

CASES = {case.id: case for case in ball_screw_cases()}
SMOOTH_HZ = 15.0
EDGE = 200
"""Samples at both ends that the smoothing needs."""
SLOW_M_PER_S = 5e-3
"""Below, the smoothed speed does not show the direction."""


def smooth(values: np.ndarray) -> np.ndarray:
    return sosfiltfilt(butter(3, SMOOTH_HZ * 2e-3, output="sos"), values)


def motion(position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x = smooth(position_m)
    v = np.gradient(x, 1e-3)
    return x, v, np.gradient(v, 1e-3)


@pytest.mark.parametrize("name", CASES)
def test_least_squares_over_the_required_force_finds_the_published_numbers(name: str) -> None:
    case: BallScrewCase = CASES[name]
    record = case.records()[0][0]
    assert record.force_n is not None
    x, v, a = motion(record.position_m)
    felt_n = smooth(record.force_n)
    start = values_of(case.start_plant())
    true = case.numbers
    first = {n: start.get(n, {"coulomb_friction.force_n": 1.0}.get(n, 0.0)) for n in true}
    unit = np.array([max(abs(first[n]), 0.1) for n in true])
    counts = np.abs(v) > SLOW_M_PER_S
    counts[:EDGE] = counts[-EDGE:] = False

    def residual(numbers: np.ndarray) -> np.ndarray:
        values = start | dict(zip(true, numbers * unit, strict=True))
        return (required_force_n(parameters_of(values), record.t_s, x, v, a) - felt_n)[counts]

    found = least_squares(residual, np.array([*first.values()]) / unit).x * unit
    for n, value in zip(true, found, strict=True):
        # Of a load that is nearly nothing only a part of the dry friction can be known.
        assert value == pytest.approx(true[n], rel=0.05, abs=0.2 if "load" in n else 0.0), n
