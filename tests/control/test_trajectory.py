"""The 7th-order motion agrees with NumPy's polynomials and with its definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from pamctl.control.waves import Motion, rest_to_rest

positions = st.floats(-0.1, 0.1)
durations = st.floats(0.05, 100.0)
shares = st.floats(0.0, 1.0)

# Of degree 7, from 0 to 1, velocity, acceleration and jerk zero at both ends: eight conditions.
CONDITIONS = np.array(
    [
        Polynomial.basis(power).deriv(order)(end) if order else Polynomial.basis(power)(end)
        for end in (0.0, 1.0)
        for order in range(4)
        for power in range(8)
    ]
).reshape(8, 8)
SHAPE = Polynomial(np.round(np.linalg.solve(CONDITIONS, [0, 0, 0, 0, 1, 0, 0, 0]), 6))


@given(positions, positions, durations, shares)
def test_motion_and_derivatives_are_those_of_the_polynomial_that_rests_at_both_ends(
    start, end, duration, share
) -> None:
    found = rest_to_rest(start, end, duration, share * duration)
    span = end - start
    for order, value in enumerate(found):
        shape = SHAPE.deriv(order) if order else SHAPE
        expected = (start if order == 0 else 0.0) + span * shape(share) / duration**order
        assert value == pytest.approx(expected, abs=1e-11 / duration**order)


@given(positions, positions, durations, st.floats(0.0, 10.0))
def test_the_position_is_constant_before_and_after_the_motion(start, end, duration, beyond) -> None:
    assert rest_to_rest(start, end, duration, -beyond) == Motion(start, 0.0, 0.0, 0.0)
    assert rest_to_rest(start, end, duration, duration + beyond) == Motion(end, 0.0, 0.0, 0.0)


def test_the_papers_transition_peaks_at_4_7_mm_per_s() -> None:
    # Half way the shape's slope is 140 / 64.
    middle = rest_to_rest(6.4e-3, 17.2e-3, 5.0, 2.5)
    assert middle.position_m == pytest.approx(11.8e-3, rel=1e-12)
    assert middle.velocity_m_per_s == pytest.approx(10.8e-3 / 5.0 * 140 / 64, rel=1e-12)
    assert middle.acceleration_m_per_s2 == pytest.approx(0.0, abs=1e-15)
