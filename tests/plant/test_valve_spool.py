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

from pamctl.plant.catalogue import CATALOGUE, Effects
from pamctl.plant.effects.valve import VALVE_SPOOL, ValveSpool, spool_step
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.paper import mechanics_step, middle_pressure_pa, pressure_step
from pamctl.plant.parameters import vented_state
from pamctl.plant.step import plant_step

PAPER_VALVE = ValveSpool(1 / (2 * math.pi * 109), 0.7)

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


@given(time_constants_s, dampings, openings_v, rates, commands_v, durations_s, durations_s)
def test_two_steps_in_a_row_are_one_long_step(
    time_constant_s: float,
    damping: float,
    opening_v: float,
    rate: float,
    command_v: float,
    first_s: float,
    second_s: float,
) -> None:
    spool = ValveSpool(time_constant_s, damping)
    halfway = spool_step(spool, opening_v, rate, command_v, first_s)
    in_two = spool_step(spool, *halfway, command_v, second_s)
    at_once = spool_step(spool, opening_v, rate, command_v, first_s + second_s)
    swing_v = abs(opening_v - command_v) + abs(rate) * time_constant_s
    assert in_two[0] == pytest.approx(at_once[0], abs=1e-11 * (1 + swing_v))
    assert in_two[1] == pytest.approx(at_once[1], abs=1e-11 * (1 + swing_v) / time_constant_s)


def test_a_step_overshoots_as_the_damping_ratio_says() -> None:
    """exp(-pi zeta / sqrt(1 - zeta^2)) after half a swing: 4.6 % at 0.7."""
    zeta = 0.7
    half_swing_s = math.pi * PAPER_VALVE.time_constant_s / math.sqrt(1 - zeta**2)
    peak_v, rate = spool_step(PAPER_VALVE, 0.0, 0.0, 1.0, half_swing_s)
    assert peak_v == pytest.approx(1 + math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2)))
    assert rate == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("frequency_hz", "gain_db"), [(1.0, 0.0), (109.0, -3.0103), (1090.0, -40.0)]
)
def test_a_valve_of_109_hz_is_3_decibels_down_at_109_hz(
    frequency_hz: float, gain_db: float
) -> None:
    """With a damping of 1 / sqrt(2) it is a Butterworth filter of second order."""
    spool = ValveSpool(1 / (2 * math.pi * 109), math.sqrt(0.5))
    per_period = 2000
    step_s = 1 / (frequency_hz * per_period)
    opening_v, rate, phasor = 0.0, 0.0, 0j
    periods = 3 + math.ceil(0.05 * frequency_hz)  # until the start is forgotten
    for i in range(periods * per_period):
        angle = 2 * math.pi * (i + 0.5) / per_period
        opening_v, rate = spool_step(spool, opening_v, rate, math.sin(angle), step_s)
        if i >= (periods - 1) * per_period:
            phasor += opening_v * np.exp(-1j * angle) * 2 / per_period
    assert 20 * math.log10(abs(phasor)) == pytest.approx(gain_db, abs=0.01)


# --- within the plant --------------------------------------------------------------------------


@given(st.floats(0.2, 2.0), st.lists(commands_v, min_size=1, max_size=50))
@examples(max_examples=30, deadline=None)
def test_a_spool_without_lag_leaves_the_papers_model_to_the_bit(
    damping: float, commands: list[float]
) -> None:
    effects = {"valve_spool": {"time_constant_s": 0.0, "damping_ratio": damping}}
    with_effect = plant_parameters(PlantSettings(effects=effects))
    without = plant_parameters(PlantSettings())
    assert without.effects == Effects()
    paper = without.paper
    state, same = vented_state(with_effect), vented_state(without)
    x, v, pressure_pa = same[:3]
    for command_v in commands:
        state = plant_step(with_effect, state, command_v, 0.5e-3)
        same = plant_step(without, same, command_v, 0.5e-3)
        # And the paper's two blocks with the command for the opening, no spool in sight.
        middle_m = x + 0.5 * 0.5e-3 * v
        middle_pa = middle_pressure_pa(paper, pressure_pa, command_v, x, middle_m, 0.5e-3)
        end_m, v = mechanics_step(paper, x, v, middle_pa, 0.5e-3)
        pressure_pa = pressure_step(paper, pressure_pa, middle_pa, command_v, x, end_m, 0.5e-3)
        x = end_m
        assert state == same
        assert state[:3] == (x, v, pressure_pa)


def test_the_flow_of_a_step_is_that_of_the_spool_in_its_middle() -> None:
    p = plant_parameters(PlantSettings(effects={"valve_spool": {"time_constant_s": 1.46e-3}}))
    after = plant_step(p, vented_state(p), 5.0, 1e-3)
    middle_v, rate = spool_step(p.effects.valve.valve_spool, 0.0, 0.0, 5.0, 0.5e-3)
    end_v, _ = spool_step(p.effects.valve.valve_spool, middle_v, rate, 5.0, 0.5e-3)
    assert after.valve.spool_v == end_v
    middle_pa = middle_pressure_pa(p.paper, p.atmospheric_pressure_pa, middle_v, 0.0, 0.0, 1e-3)
    expected_pa = pressure_step(
        p.paper, p.atmospheric_pressure_pa, middle_pa, middle_v, 0.0, after.position_m, 1e-3
    )
    assert after.pressure_pa == expected_pa


def test_the_catalogue_describes_the_spool_as_its_kernel_takes_it() -> None:
    assert CATALOGUE["valve_spool"] is VALVE_SPOOL
    neutral = ValveSpool(**{p.name: p.neutral for p in VALVE_SPOOL.parameters})
    assert neutral == ValveSpool() == Effects().valve.valve_spool
    for parameter in VALVE_SPOOL.parameters:
        assert parameter.low <= parameter.neutral <= parameter.high
