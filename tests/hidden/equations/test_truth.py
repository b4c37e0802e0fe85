"""The truths are correct before the diagnosis is examined on them.

What is expected comes from SciPy's solvers on the paper's equations, from conservation, or from
the limits of friction.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from hidden.effects import IN_TRUTH, ON_SENSORS
from hidden.equations.advance import at_rest
from hidden.equations.air import air_of
from hidden.equations.machine_code import prepare_step
from hidden.equations.truth import State, Truth
from hidden.excitations import Excitation, multisine
from hidden.rig import HiddenRig, Passage, Record, hidden_rig
from hidden.sensors import ENCODER_STEP_M, Sensors

Array = NDArray[np.float64]
PAPER = Truth()
STEP_S = 20e-6


def passed(truth: Truth, excitation: Excitation, step_s: float = 0.0) -> Passage:
    """Run with perfect sensors."""
    return HiddenRig(truth, Sensors(perfect=True), seed=0, step_s=step_s).run(excitation)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# --- Eq. 9, written a third time, for a smooth stretch of motion -------------------------------


def equation_9(_t: float, y: Array, command_v: float, forward: bool) -> list[float]:
    x, v, pressure = y
    length, gauge = 0.2 - x, pressure - 101.3e3
    room = length * (0.232**2 - length**2) / (4 * math.pi * 1.94**2)
    area = (3 * length**2 - 0.232**2) / (4 * math.pi * 1.94**2)
    friction = 570.0 * v
    if forward:
        theta = math.acos(length / 0.232)
        grip = 55.3 * 100 * 0.233e-6 * gauge
        friction += grip * (0.232 * theta * math.cos(theta) + v)
    up, down = (441.3e3, pressure) if command_v > 0 else (pressure, 101.3e3)
    ratio = max(down / up, (2 / 2.4) ** 3.5)
    psi = up * math.sqrt(2.8 / (0.4 * 287.1 * 273.0) * (ratio ** (2 / 1.4) - ratio ** (2.4 / 1.4)))
    inflow = 1.03e-6 * command_v * psi
    return [
        v,
        (gauge * area - friction - 9680.0 * x) / 0.05,
        (287.1 * 273.0 * inflow - pressure * area * v) / room,
    ]


def stepped(state: State, command_v: float, seconds: float) -> list[State]:
    states, step = [state], Stepper(PAPER, state)
    for _ in range(round(seconds / STEP_S)):
        states.append(step(command_v))
    return states


class Stepper:
    """Advances a truth by one small step a call."""

    def __init__(self, truth: Truth, state: State) -> None:
        self._call = prepare_step(truth, state, STEP_S)

    def __call__(self, command_v: float) -> State:
        self._call.put("command_v", command_v)
        self._call.run()
        state: State = self._call.get("s")
        return state


@pytest.mark.parametrize(
    ("x", "pressure_pa", "command_v", "seconds", "forward"),
    [
        (0.0, 102e3, 5.0, 0.060, True),
        (0.0, 102e3, 1.5, 0.150, True),
        (15e-3, 150e3, -5.0, 0.080, False),
        (15e-3, 150e3, -0.6, 0.150, False),
    ],
)
def test_a_smooth_stretch_follows_the_papers_equation(
    x: float, pressure_pa: float, command_v: float, seconds: float, forward: bool
) -> None:
    start = at_rest(PAPER, command_v)._replace(
        x=x, pressure_pa=pressure_pa, line_pa=pressure_pa, air=air_of(PAPER, pressure_pa, x)
    )
    states = stepped(start, command_v, seconds)
    exact = solve_ivp(
        equation_9, (0.0, seconds), [x, 0.0, pressure_pa], "LSODA",
        args=(command_v, forward), rtol=1e-9, atol=[1e-10, 1e-8, 1e-2],
    )  # fmt: skip
    assert exact.success
    assert abs(states[-1].x - exact.y[0, -1]) < 0.1e-6
    assert abs(states[-1].pressure_pa - exact.y[2, -1]) < 20.0
    assert abs(states[-1].x - x) > 0.5e-3, "it must really have moved"


# --- conservation, rest, friction --------------------------------------------------------------


def test_a_closed_muscle_keeps_its_air() -> None:
    volts = np.concatenate([np.full(50, 5.0), np.zeros(1000)])
    run = passed(PAPER, Excitation("burst", volts, rest_v=0.0))
    length = 0.2 - run.true_position_m
    room = length * (0.232**2 - length**2) / (4 * math.pi * 1.94**2)
    air = (run.true_pressure_pa * room)[51:]
    assert np.ptp(run.true_position_m[51:]) > 1e-3
    assert np.ptp(air) < 1e-9 * air[0]


def test_air_from_a_tank_without_refill_enters_the_muscle() -> None:
    truth = PAPER._replace(regulator_pa_s_per_kg=1e13, tank_m3=1e-3)
    state = at_rest(truth, 0.0)
    before = truth.tank_m3 * state.tank_pa + state.air
    step = Stepper(truth, state)
    for k in range(10_000):
        state = step(3.0 * math.sin(k / 900.0) ** 2)
    assert state.tank_pa < 430e3
    assert truth.tank_m3 * state.tank_pa + state.air == pytest.approx(before, rel=1e-6)


def test_a_resting_muscle_stays_while_the_net_force_lies_inside_the_friction_band() -> None:
    state = stepped(at_rest(PAPER, 5.0), 5.0, 0.8)[-1]
    assert state.v < 1e-6
    held = state.x
    step = Stepper(PAPER, state)
    while abs(state.v) < 1e-9 or state.v > 0.0:
        resting = state
        state = step(-0.05)
    assert held - resting.x < 1e-6
    gauge, length = resting.pressure_pa - 101.3e3, 0.2 - held
    net = gauge * (3 * length**2 - 0.232**2) / (4 * math.pi * 1.94**2) - 9680.0 * held
    assert abs(net) < 0.05, "it slips back only when friction has fallen to the lower end, zero"
    assert resting.pressure_pa < 0.95 * 441.3e3


@pytest.mark.parametrize("name", ["stribeck", "presliding", "line_restriction", "command_delay"])
def test_halving_the_step_moves_a_hard_truth_by_less_than_a_count(name: str) -> None:
    rig = hidden_rig({name: 3}, seed=4)
    excitation = multisine(1.2, 0.3, 60.0, 1.0, seed=1, bias_v=0.05)
    fine = replace(rig, step_s=2.5e-6, sensors=Sensors(perfect=True)).run(excitation)
    coarse = replace(rig, sensors=Sensors(perfect=True)).run(excitation)
    assert rms(coarse.true_position_m - fine.true_position_m) < ENCODER_STEP_M
    assert rms(coarse.true_pressure_pa - fine.true_pressure_pa) < 30.0


# --- what is hidden ----------------------------------------------------------------------------

PROBE = multisine(2.0, 0.5, 40.0, 1.0, seed=2)


@pytest.mark.parametrize("key", sorted({**IN_TRUTH, **ON_SENSORS}))
def test_an_effect_of_size_zero_hides_nothing(key: str) -> None:
    name, _, form = key.partition("/")
    none = hidden_rig({name: (0, form)}, seed=3, miscalibrated=False)
    assert none.truth == PAPER


@cache
def plain_probe() -> Record:
    plain = hidden_rig({}, seed=3, miscalibrated=False)
    return replace(plain, sensors=Sensors(perfect=True), step_s=STEP_S).run(PROBE).record


@pytest.mark.parametrize("key", sorted({**IN_TRUTH, **ON_SENSORS}))
def test_a_larger_effect_is_more_visible(key: str) -> None:
    name, _, form = key.partition("/")
    base, apart = plain_probe(), []
    for size in (0.1, 10):
        rig = hidden_rig({name: (size, form)}, seed=3, miscalibrated=False)
        clear = replace(rig.sensors, perfect=True)
        seen = replace(rig, sensors=clear, step_s=STEP_S).run(PROBE).record
        assert seen.pressure_pa is not None
        assert seen.position_m is not None
        apart.append(
            rms(seen.pressure_pa - base.pressure_pa) / 300.0
            + rms(seen.position_m - base.position_m) / ENCODER_STEP_M
        )
    assert apart[0] < apart[1]
