"""The lagging spool of the valve agrees with SciPy's linear systems."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from pamctl.plant.effects.valve import ValveSpool, spool_step

dampings = st.one_of(st.sampled_from([0.2, 1.0, 2.0]), st.floats(0.2, 2.0))
time_constants_s = st.floats(1e-5, 8e-3)
openings_v = st.floats(-5.0, 5.0)
rates = st.floats(-1e4, 1e4)
commands_v = st.floats(-5.0, 5.0)
durations_s = st.floats(1e-6, 5e-3)


def exact(
    spool: ValveSpool, opening_v: float, rate: float, command_v: float, duration_s: float
) -> NDArray[np.float64]:
    """exp(A t) of s'' = w^2 (u - s) - 2 zeta w s', in time constants to scale the matrix."""
    companion = np.array([[0.0, 1.0], [-1.0, -2.0 * spool.damping_ratio]])
    scaled = expm(companion * duration_s / spool.time_constant_s) @ [
        opening_v - command_v,
        rate * spool.time_constant_s,
    ]
    return np.array([command_v + scaled[0], scaled[1] / spool.time_constant_s])


@given(time_constants_s, dampings, openings_v, rates, commands_v, durations_s)
@examples(max_examples=60, deadline=None)
def test_the_spool_moves_as_a_linear_system_of_second_order(
    time_constant_s: float,
    damping: float,
    opening_v: float,
    rate: float,
    command_v: float,
    duration_s: float,
) -> None:
    spool = ValveSpool(time_constant_s, damping)
    ours = spool_step(spool, opening_v, rate, command_v, duration_s)
    expected = exact(spool, opening_v, rate, command_v, duration_s)
    swing_v = abs(opening_v - command_v) + abs(rate) * time_constant_s
    assert ours[0] == pytest.approx(expected[0], abs=1e-11 * (1 + swing_v))
    assert ours[1] == pytest.approx(expected[1], abs=1e-11 * (1 + swing_v) / time_constant_s)


@pytest.mark.parametrize("damping", [1 - 1e-3, 1 - 1e-9, 1 - 2**-53, 1 + 2**-52, 1 + 1e-9])
def test_the_spool_is_continuous_at_critical_damping(damping: float) -> None:
    near = partial(spool_step, ValveSpool(1.46e-3, damping), 1.0, -200.0, 5.0)
    critical = partial(spool_step, ValveSpool(1.46e-3, 1.0), 1.0, -200.0, 5.0)
    for duration_s in (1e-5, 1e-3, 1e-2):
        difference = 5.0 * abs(damping - 1.0) + 1e-13
        assert near(duration_s)[0] == pytest.approx(critical(duration_s)[0], abs=difference)


@given(st.floats(1e-9, 1e-5), st.floats(0.2, 2.0), openings_v, commands_v, durations_s)
def test_a_spool_much_faster_than_the_step_arrives_within_it(
    time_constant_s: float, damping: float, opening_v: float, command_v: float, duration_s: float
) -> None:
    """A fit passes such values on its way to the neutral value."""
    opening_v, rate = spool_step(
        ValveSpool(time_constant_s, damping), opening_v, 0.0, command_v, duration_s + 1e-3
    )
    # The slower pole is w (zeta - sqrt(zeta^2 - 1)), and 0.2 w at the least.
    assert opening_v == pytest.approx(command_v, abs=10 * math.exp(-0.2 * 1e-3 / time_constant_s))
    assert rate == pytest.approx(0.0, abs=1e-2)


def test_a_spool_of_first_order_covers_63_percent_in_its_time_constant_in_any_steps() -> None:
    spool = ValveSpool(18e-3, order=1.0)
    opening_v, rate = 1.0, 0.0
    for _ in range(18):
        opening_v, rate = spool_step(spool, opening_v, rate, 4.0, 1e-3)
    assert opening_v == pytest.approx(4.0 - 3.0 / math.e)
    assert rate == pytest.approx(3.0 / math.e / 18e-3)
