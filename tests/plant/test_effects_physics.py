"""Every effect's physics agrees with SciPy's solution of independent equations.

Two steps a tick are within a part of the sensor's noise (300 Pa) and a count or two of the
encoder (3.2 um); finer steps converge to the independent solution.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import support.equations.paper_equations as paper
from support.equations.effect_equations import Mechanics, solve_pressure

from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.drive import drive_mechanics, drive_pressure
from pamctl.plant.parameters import parameters_of

TICK_S = 1e-3
TICKS = 360
# Full filling and exhausting, both ends of the pressure, small steps to either side, closed holds.
COMMAND_V = [
    u
    for u, ticks in (
        (5, 60),
        (-5, 25),
        (0, 30),
        (0.6, 40),
        (-0.8, 40),
        (0.2, 30),
        (3, 40),
        (-5, 95),
    )
    for u in [float(u)] * ticks
]
POSITION_M = 8e-3 - 8e-3 * np.cos(2 * np.pi * 4 * TICK_S * np.arange(TICKS))
# Up, a rest, a small swing that reverses, up, and down to the vented muscle.
PRESSURE_PA = paper.P_ATM + 1e3 * np.interp(
    np.arange(500),
    [0, 10, 110, 160, 200, 240, 280, 380, 480, 500],
    [0, 0, 220, 220, 180, 225, 190, 320, 0, 0],
)

PRESSURE_CASES = {
    "paper": {},
    "valve_deadband": {"fill_width_v": 0.3, "exhaust_width_v": 0.1},
    "valve_asymmetry": {"exhaust_gain": 0.7},
    "valve_saturation": {"shortfall_v": 1.5},
    "null_offset": {"offset_v": 0.15},
    "valve_slew": {"slowness_s_per_v": 2.3e-3},
    "valve_curve": {"curvature_per_v": 0.05, "exponent": 1.2},
    "valve_spool": {"time_constant_s": 3e-3, "damping_ratio": 0.5},
    "valve_hysteresis": {"width_v": 0.3},
    "valve_leak": {"area_m2": 5e-8, "fade_per_v": 0.5},
    "command_delay": {"delay_s": 2.37e-3},
    "chamber_leak": {"area_m2": 5e-8},
    "discharge_ratio": {"shift": -0.2},
    "supply_droop": {"resistance_pa_s_per_kg": 1e7},
    "supply_droop/tank": {"resistance_pa_s_per_kg": 2e7, "refill_time_s": 0.03},
    "supply_droop/two_tanks": {
        "resistance_pa_s_per_kg": 2e7,
        "refill_time_s": 0.1,
        "fast_share": 0.4,
    },
    "supply_ripple": {"amplitude_pa": 2e4, "frequency_hz": 6.1, "phase_rad": 0.8},
    "line_restriction": {"resistance_pa_s_per_kg": 1e7},
    "line_restriction/volume": {"resistance_pa_s_per_kg": 1e7, "volume_m3": 4e-6},
    "line_restriction/turbulent": {
        "resistance_pa_s_per_kg": 3e6,
        "turbulent_pa_s2_per_kg2": 2e10,
    },
    "dead_volume": {"volume_m3": 1e-5},
    "polytropic": {"exponent": 1.25},
    "braid_stretch": {"compliance_per_pa": 1e-7},
    "end_cap": {"length_m": 5e-3},
    "drift": {"valve_gain_per_s": -0.01},
    "pressure_sensor_lag": {"time_constant_s": 3e-3},
    "pressure_sensor_offset": {"offset_pa": 4e3},
    "pressure_sensor_gain": {"gain": 1.05},
}
MECHANICS_CASES = {
    "paper": {},
    "presliding": {"compliance_m_per_n": 1e-5},
    "presliding/dahl": {"compliance_m_per_n": 1e-5, "form": 1.0},
    "presliding/lugre": {
        "compliance_m_per_n": 1e-5,
        "form": 2.0,
        "bristle_damping_n_s_per_m": 200.0,
    },
    "presliding/maxwell_slip": {
        "compliance_m_per_n": 1e-5,
        "form": 3.0,
        "second_over_first": 1.7,
        "third_over_first": 5.0,
        "fourth_over_first": 0.6,
    },
    "stribeck": {"rise": 0.15, "speed_m_per_s": 2e-2, "exponent": 2.0},
    "stribeck/tustin": {"rise": 0.1, "speed_m_per_s": 3e-2, "exponent": 1.0},
    "return_friction": {"share": 0.5},
    "coulomb_friction": {"force_n": 5.0},
    "friction_asymmetry": {"share": 0.3},
    "pressure_friction": {"n_per_pa": 2e-5},
    "pressure_damping": {"per_pa": 1e-3},
    "viscous_asymmetry": {"share": -0.4},
    "position_friction": {"share_per_m": 40.0},
    "spring_hysteresis": {"force_n": 2.0, "way_m": 1.5e-3},
    "cubic_stiffness": {"n_per_m3": 3e6},
    "creep": {"stiffness_n_per_m": 1500.0, "time_constant_s": 0.1},
    "creep/two_branches": {
        "stiffness_n_per_m": 1500.0,
        "time_constant_s": 0.3,
        "fast_share": 0.4,
    },
    "bladder_threshold": {"pressure_pa": 2e4},
    "braid_stretch": {"compliance_per_pa": 1e-7},
    "end_cap": {"length_m": 5e-3},
    "external_load": {"force_n": 8.0},
    "moving_mass": {"added_kg": 1.0},
    "piston": {"area_m2": -2e-5},
    "drift": {"stiffness_per_s": 0.01, "friction_per_s": -0.01},
}


def flat(case: str, values: dict[str, float]) -> dict[str, float]:
    return {f"{case.split('/')[0]}.{name}": value for name, value in values.items()}


@pytest.mark.parametrize("case", PRESSURE_CASES)
def test_the_pressure_block_solves_the_effects_equations(case: str) -> None:
    values = flat(case, PRESSURE_CASES[case])
    exact_pa = solve_pressure(values, COMMAND_V, POSITION_M, TICK_S)

    def error_pa(steps: int) -> float:
        ours = drive_pressure(parameters_of(values), COMMAND_V, POSITION_M, TICK_S, steps=steps)
        return float(np.abs(ours.pressure_pa - exact_pa).max())

    plain = drive_pressure(parameters_of({}), COMMAND_V, POSITION_M, TICK_S)
    effect_pa = float(np.abs(plain.pressure_pa - exact_pa).max())
    if case != "paper":
        assert effect_pa > 300.0
    # At two steps a tick: most below 5 Pa; to 180 Pa where a step holds the end of a filling,
    # or a line of half a millisecond.
    assert error_pa(2) < 200.0
    assert error_pa(32) < 4.0


@pytest.mark.long
@pytest.mark.parametrize("case", MECHANICS_CASES)
def test_the_mechanics_solve_the_effects_equations(case: str) -> None:
    values = flat(case, MECHANICS_CASES[case])
    exact_m = Mechanics(values, PRESSURE_PA, TICK_S).solve()

    def error_um(steps: int) -> float:
        ours = drive_mechanics(parameters_of(values), PRESSURE_PA, TICK_S, steps=steps)
        return float(np.abs(ours.position_m - exact_m).max() * 1e6)

    plain = drive_mechanics(parameters_of({}), PRESSURE_PA, TICK_S)
    effect_um = float(np.abs(plain.position_m - exact_m).max() * 1e6)
    if case != "paper":
        assert effect_um > 2.0
    assert error_um(2) < 8.0  # most below 0.3 um, bristles 0.5 to 1.2 um
    # Springs on sliders: their second order leaves 0.09 and 0.14 um.
    sliders = case in ("presliding", "presliding/maxwell_slip")
    assert error_um(32) < (0.2 if sliders else 0.1)


def test_every_effect_is_compared_with_an_independent_solution() -> None:
    """The encoder's two are closed forms, below."""
    solved = {case.split("/")[0] for case in (*PRESSURE_CASES, *MECHANICS_CASES)} - {"paper"}
    assert solved | {"encoder_scale", "encoder_backlash"} == set(CATALOGUE)


def test_the_encoder_shows_a_scaled_position_with_a_play() -> None:
    values = {"encoder_scale.scale": 1.02, "encoder_backlash.width_m": 2e-4}
    ours = drive_mechanics(parameters_of(values), PRESSURE_PA, TICK_S, steps=8)
    shown, expected = 0.0, []
    for x in ours.true_position_m.tolist():
        if x - shown > 1e-4:
            shown = x - 1e-4
        elif shown - x > 1e-4:
            shown = x + 1e-4
        expected.append(1.02 * shown)
    # Between samples the muscle turns within a tick at the most.
    np.testing.assert_allclose(ours.position_m, expected, rtol=0, atol=3e-6)


@pytest.mark.parametrize("shift", [-0.328, -0.228, -0.1])
def test_the_moved_nozzle_is_near_iso_6358s_ellipse(shift: float) -> None:
    from pamctl.plant.effects.air import DischargeRatio, nozzle_ratio

    b = paper.CRITICAL_RATIO + shift
    for ratio in np.linspace(0.05, 0.999, 60).tolist():
        moved = nozzle_ratio(DischargeRatio(shift), ratio, paper.CRITICAL_RATIO)
        ours = paper.psi(1e5, 1e5 * max(moved, 0.0)) / paper.psi(1e5, 0.0)
        ellipse = math.sqrt(1 - max(0.0, (ratio - b) / (1 - b)) ** 2)
        assert ours == pytest.approx(ellipse, abs=3e-3)
