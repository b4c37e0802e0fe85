"""The laws agree with an independent form of the paper's equations and of the model's flow."""

import math
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.paper_equations import (
    P_ATM,
    P_TANK,
    C,
    M,
    drive,
    grip,
    kinetic_friction,
    pressure_rate,
)

from pamctl.control.law import Gains
from pamctl.control.law import respond as respond_armed
from pamctl.control.law_registry import _SHIPPED, GROUP, law_of
from pamctl.control.pid import PidSettings
from pamctl.control.qsmc import QsmcSettings
from pamctl.control.sliding import Absement
from pamctl.control.smc import SmcSettings, linearise_model
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.realtime.tick import freeze_state
from pamctl.signals import Command, Estimate, Phase, Reference

NAN = math.nan
ARMED = Absement(0.0)
DT_S = 1e-3
INCH_M = 25.4e-3

QSMC = {
    "law": "qsmc",
    "length_unit": "inch",
    "lambda_per_s": 10.0,
    "q": 1.75,
    "kp_v_s3_per_length": 2e-4,
    "eta": 0.4016,
    "phi": 0.02008,
    "lpf2_hz": 0.5,
}
SMC = {
    "law": "smc",
    "length_unit": "mm",
    "lambda_per_s": 200.0,
    "q": 1.0,
    "kp": 1.0,
    "eta": 25.4,
    "phi": 2.54,
    "lpf2_hz": 185.0,
}
PID = {
    "law": "pid",
    "length_unit": "mm",
    "kp_v_per_length": 2.0,
    "ki_v_per_length_s": 30.0,
    "kd_v_s_per_length": 0.05,
    "lpf2_hz": 185.0,
}
_MODELS: dict[str, Any] = {"qsmc": QsmcSettings, "smc": SmcSettings, "pid": PidSettings}


def respond(made: Gains, memory: Absement, *seen: Any) -> tuple[Command, Absement]:
    return respond_armed(made, ARMED, memory, *seen)


def gains(law: dict[str, Any], **changes: Any) -> Any:
    settings = _MODELS[law["law"]](**{**law, **changes})
    return law_of(settings).to_gains(settings)


def unlimited(made: Any) -> Any:
    """Without the command limit every term shows in the command."""
    free = 1e12
    if hasattr(made, "sliding"):
        return made._replace(sliding=made.sliding._replace(limit_v=free))
    return made._replace(limit_v=free)


def errors(e: float, rate: float, acceleration: float, x: float = 0.01, p: float = 2e5) -> Estimate:
    return Estimate(x, p, e, rate, acceleration)


def moving(jerk: float = 0.0, velocity: float = 0.0, acceleration: float = 0.0) -> Reference:
    return Reference(Phase.TRACK, 0.01, velocity, acceleration, jerk, NAN)


REST = moving()


def eq_15(literal: bool, eta: float, phi: float, s: float) -> float:
    sat = s / phi if abs(s / phi) < 1 else math.copysign(1.0, s)
    return eta * abs(s) * sat if literal else eta * sat


def eq_17(
    law: dict[str, Any], e: float, rate: float, acceleration: float, jerk: float, absement: float
) -> float:
    """Everything in the unit of the gains, as the paper has it."""
    le = law["lambda_per_s"] ** law["q"]
    s = acceleration + 3 * le * rate + 3 * le**2 * e + le**3 * absement
    u_rb = eq_15(law.get("reaching_law", "eta_abs_s") == "eta_abs_s", law["eta"], law["phi"], s)
    equivalent = jerk - 3 * le * acceleration - 3 * le**2 * rate - le**3 * e
    return law["kp_v_s3_per_length"] * (equivalent - u_rb)


small = st.floats(-1e-3, 1e-3)
rates = st.floats(-0.1, 0.1)
accelerations = st.floats(-10, 10)
jerks = st.floats(-100, 100)
absements = st.floats(-1e-3, 1e-3)
units = st.sampled_from(["mm", "inch"])
readings = st.sampled_from(["eta_abs_s", "eta"])
UNIT_M = {"mm": 1e-3, "inch": INCH_M}


@given(small, rates, accelerations, jerks, absements, units, readings, st.floats(0.5, 2.0))
def test_qsmc_is_eq_17_in_the_unit_of_its_gains(e, rate, acc, jerk, absement, unit, reading, q):
    law = {**QSMC, "length_unit": unit, "reaching_law": reading, "q": q}
    command, state = respond(
        unlimited(gains(law)), Absement(absement), moving(jerk), errors(e, rate, acc), DT_S
    )
    one = UNIT_M[unit]
    sum_of_errors = absement + e * DT_S
    expected = eq_17(law, e / one, rate / one, acc / one, jerk / one, sum_of_errors / one)
    size = sum(map(abs, (command.equivalent_v, command.robust_v, 1e-9)))
    assert command.command_v == pytest.approx(expected, abs=1e-9 * size)
    assert command.command_v == pytest.approx(command.equivalent_v + command.robust_v)
    assert state.absement_m_s == pytest.approx(sum_of_errors)
    assert not command.saturated


def test_the_surface_on_record_is_eq_11_in_si():
    pole = 10.0**1.75
    command, _ = respond(gains(QSMC), Absement(2e-6), REST, errors(1e-5, 2e-4, 3e-3), DT_S)
    absement = 2e-6 + 1e-5 * DT_S
    s = 3e-3 + 3 * pole * 2e-4 + 3 * pole**2 * 1e-5 + pole**3 * absement
    assert command.surface_m_per_s2 == pytest.approx(s, rel=1e-12)


@given(small, rates, accelerations, jerks, absements, readings)
def test_gains_converted_with_their_units_are_the_same_law(e, rate, acc, jerk, absement, reading):
    """K_p carries 1/length, phi length; eta is 1/s in Eq. 15 as printed, else length/s^3."""
    mm_per_inch = 25.4
    in_mm = {
        "length_unit": "mm",
        "kp_v_s3_per_length": QSMC["kp_v_s3_per_length"] / mm_per_inch,
        "phi": QSMC["phi"] * mm_per_inch,
        "eta": QSMC["eta"] * (1.0 if reading == "eta_abs_s" else mm_per_inch),
    }
    asked = (Absement(absement), moving(jerk), errors(e, rate, acc), DT_S)
    inch, _ = respond(unlimited(gains(QSMC, reaching_law=reading)), *asked)
    mm, _ = respond(unlimited(gains(QSMC, reaching_law=reading, **in_mm)), *asked)
    size = 1e-9 * (abs(inch.equivalent_v) + abs(inch.robust_v)) + 1e-12
    assert mm.command_v == pytest.approx(inch.command_v, abs=size)
    assert mm.robust_v == pytest.approx(inch.robust_v, abs=size)


@given(small, rates, accelerations, absements, readings)
def test_smc_gains_convert_with_their_units_too(e, rate, acc, absement, reading):
    """Its K_p has no unit."""
    in_inch = {
        "length_unit": "inch",
        "phi": SMC["phi"] / 25.4,
        "eta": SMC["eta"] / (1.0 if reading == "eta_abs_s" else 25.4),
    }
    asked = (Absement(absement), REST, errors(e, rate, acc), DT_S)
    mm, _ = respond(unlimited(gains(SMC, reaching_law=reading)), *asked)
    inch, _ = respond(unlimited(gains(SMC, reaching_law=reading, **in_inch)), *asked)
    assert inch.command_v == pytest.approx(mm.command_v, rel=1e-9, abs=1e-9)
    assert inch.robust_v == pytest.approx(mm.robust_v, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("share", [-3.0, 0.25, 1.0])
def test_both_readings_of_eq_15(share):
    """At rest with only an integral of the error, s = lambda^(3 q) int e."""
    eta, phi = 0.4016, 0.02008  # inch/s^2
    s = share * phi
    absement = s * INCH_M / (10.0**1.75) ** 3
    robust = {
        reading: respond(
            gains(QSMC, reaching_law=reading), Absement(absement), REST, errors(0, 0, 0), DT_S
        )[0].robust_v
        for reading in ("eta_abs_s", "eta")
    }
    sat = max(-1.0, min(1.0, share))
    assert robust["eta_abs_s"] == pytest.approx(-2e-4 * eta * abs(s) * sat, abs=1e-18)
    assert robust["eta"] == pytest.approx(-2e-4 * eta * sat, abs=1e-18)


@given(small, rates, accelerations, absements, st.floats(1.0, 20.0), st.floats(0.5, 3.0))
def test_q_enters_as_lambda_to_its_power(e, rate, acc, absement, lam, q):
    asked = (Absement(absement), REST, errors(e, rate, acc), DT_S)
    for law in (QSMC, SMC):
        raised, _ = respond(gains(law, lambda_per_s=lam, q=q), *asked)
        plain, _ = respond(gains(law, lambda_per_s=lam**q, q=1.0), *asked)
        assert raised.command_v == pytest.approx(plain.command_v, rel=1e-9, abs=1e-12)
        assert raised.surface_m_per_s2 == pytest.approx(plain.surface_m_per_s2, rel=1e-9, abs=1e-12)


def acceleration_of(x: float, v: float, p: float) -> float:
    """Second row of Eq. 9 away from rest."""
    friction = C * v + (kinetic_friction(x, p) + grip(p) * v if v > 0 else 0.0)
    return (drive(x, p) - friction) / M


def jerk_along_flow(x: float, v: float, p: float, u: float) -> float:
    """Central difference of x'' along the flow of Eq. 9."""
    a, p_rate = acceleration_of(x, v, p), pressure_rate(u, x, v, p)

    def at(t: float) -> float:
        return acceleration_of(x + v * t, v + a * t, p + p_rate * t)

    step = min(1e-6, 1e-3 * abs(v) / max(abs(a), 1e-9))  # never through v = 0
    return (at(step) - at(-step)) / (2 * step)


MODEL = plant_parameters(PlantSettings()).paper

states = st.tuples(
    st.floats(0.0, 0.024),
    st.floats(1e-3, 0.3) | st.floats(-0.3, -1e-3),
    st.floats(P_ATM * 1.03, P_TANK * 0.97),
)
commands = st.floats(0.01, 5) | st.floats(-5, -0.01)


@given(states, commands)
def test_the_model_of_smc_is_the_third_derivative_along_the_flow(state, u):
    x, v, p = state
    a = acceleration_of(x, v, p)
    model = linearise_model(MODEL, x, v, a, p)
    gain = model.fill_gain if u > 0 else model.exhaust_gain
    # x''' is a small difference of large terms: the size of each is what the error scales with.
    size = abs(model.drift_m_per_s3) + abs(gain * u) + abs(a) * C / M
    assert model.drift_m_per_s3 + gain * u == pytest.approx(
        jerk_along_flow(x, v, p, u), abs=2e-7 * size
    )


@given(
    states,
    st.floats(-1e-4, 1e-4),
    st.floats(-0.05, 0.05),
    st.floats(-50, 50),
    st.floats(-1e4, 1e4),
    st.floats(-1e-6, 1e-6),
)
def test_smc_cancels_a_muscle_that_equals_its_model(state, e, rate, error_acc, jerk, absement):
    """With K_p = 1 the muscle's x''' under the command is the x''' that Eq. 16 wants."""
    x, v, p = state
    a = acceleration_of(x, v, p)
    asked = Reference(Phase.TRACK, x - e, v - rate, a - error_acc, jerk, NAN)
    command, state_after = respond(
        unlimited(gains(SMC)), Absement(absement), asked, Estimate(x, p, e, rate, error_acc), DT_S
    )
    le = SMC["lambda_per_s"]
    s = error_acc + 3 * le * rate + 3 * le**2 * e + le**3 * state_after.absement_m_s
    u_rb_mm = eq_15(True, SMC["eta"], SMC["phi"], s * 1e3)
    wanted = jerk - 3 * le * error_acc - 3 * le**2 * rate - le**3 * e - u_rb_mm * 1e-3
    size = abs(wanted) + abs(command.command_v) * 4e4 + abs(a) * C / M
    assert jerk_along_flow(x, v, p, command.command_v) == pytest.approx(wanted, abs=2e-6 * size)


def test_a_balanced_pressure_gives_a_finite_command():
    """At tank or atmospheric pressure no air flows at any opening: g-hat has a lower limit."""
    for p in (P_ATM, P_TANK):
        for jerk in (1e3, -1e3):
            command, _ = respond(
                unlimited(gains(SMC)), ARMED, moving(jerk), errors(0, 0, 0, 0.01, p), DT_S
            )
            assert abs(command.command_v) < 1e3 / 1e3


def test_pid_is_the_sum_of_its_three_terms():
    command, state = respond(gains(PID), Absement(1e-5), REST, errors(0.2e-3, -1e-3, 7.0), DT_S)
    absement_mm = 1e-2 + 0.2 * DT_S
    assert state.absement_m_s == pytest.approx(absement_mm * 1e-3)
    assert command.equivalent_v == pytest.approx(-(2.0 * 0.2 + 0.05 * -1.0))
    assert command.robust_v == pytest.approx(-30.0 * absement_mm)
    assert command.command_v == pytest.approx(command.equivalent_v + command.robust_v)
    assert math.isnan(command.surface_m_per_s2)


def test_pid_gains_in_inches_are_per_inch():
    e = errors(1e-4, 2e-3, 0.0)
    scaled = {
        key: PID[key] * 25.4
        for key in ("kp_v_per_length", "ki_v_per_length_s", "kd_v_s_per_length")
    }
    mm, _ = respond(gains(PID), Absement(1e-5), REST, e, DT_S)
    inch, _ = respond(gains(PID, length_unit="inch", **scaled), Absement(1e-5), REST, e, DT_S)
    assert inch[0] == pytest.approx(mm[0], rel=1e-12)
    assert inch[2:4] == pytest.approx(mm[2:4], rel=1e-12)


every_law = pytest.mark.parametrize("law", [QSMC, SMC, PID], ids=lambda law: law["law"])


@every_law
@pytest.mark.parametrize("limit_v", [1.0, 5.0])
def test_the_command_stops_at_the_limit_of_the_law_and_is_marked_as_saturated(law, limit_v):
    made = gains(law, command_limit_v=limit_v)
    for e, expected in ((0.5, -limit_v), (-0.5, limit_v)):
        command, _ = respond(made, ARMED, REST, errors(e, 0, 0), DT_S)
        assert command.command_v == expected
        assert command.saturated
        assert abs(command.equivalent_v + command.robust_v) > limit_v
    command, _ = respond(made, ARMED, REST, errors(0.0, 0, 0), DT_S)
    assert not command.saturated


def answers(made: Gains, errors_m: Sequence[float], state: Absement = ARMED) -> list[Any]:
    found: list[tuple[Command, Absement]] = []
    for e in errors_m:
        command, state = respond(made, state, REST, errors(e, 0, 0), DT_S)
        found.append((command, state))
    return found


@every_law
def test_an_integral_that_is_too_large_is_unwound_even_at_the_limit(law):
    made = gains(law)
    wound = Absement(1e-2)  # holds the command at the lower limit by itself
    found = answers(made, [-1e-4] * 50, wound)
    absements = [state.absement_m_s for _, state in found]
    assert found[0][0].command_v == -5.0
    assert absements == sorted(absements, reverse=True)
    assert absements[-1] == pytest.approx(1e-2 - 50 * 1e-4 * DT_S)


@every_law
@given(valve_v=st.floats(-5, 5), absement=absements)
def test_an_open_loop_command_passes_unchanged_and_clears_the_integral(law, valve_v, absement):
    asked = Reference(Phase.OPEN_LOOP, NAN, NAN, NAN, NAN, valve_v)
    nothing = Estimate(0.01, 2e5, NAN, NAN, NAN)
    command, state = respond(gains(law), Absement(absement), asked, nothing, DT_S)
    assert command.command_v == valve_v
    assert (command.equivalent_v, command.robust_v, command.saturated) == (0.0, 0.0, False)
    assert math.isnan(command.surface_m_per_s2)
    assert state == ARMED


@every_law
@given(inputs=st.lists(st.tuples(small, rates, accelerations, jerks), min_size=2, max_size=20))
def test_a_law_is_pure_and_continues_from_a_restored_state(law, inputs):
    made = gains(law)

    def replayed(thaw: Callable[[Absement], Absement]) -> list[tuple[Command, Absement]]:
        state, found = ARMED, []
        for e, rate, acc, jerk in inputs:
            asked = (moving(jerk), errors(e, rate, acc), DT_S)
            command, state = respond(made, thaw(state), *asked)
            found.append((command._replace(surface_m_per_s2=0.0), state))
        return found

    straight = replayed(lambda state: state)
    assert replayed(lambda state: state) == straight
    assert replayed(lambda state: Absement(*freeze_state(state))) == straight


def test_the_shipped_laws_are_those_that_the_package_declares():
    pyproject = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    declared = pyproject["project"]["entry-points"][GROUP]
    assert declared == {point.name: point.value for point in _SHIPPED}
