"""The plant's physics: geometry, flow, friction, conservation, and its two blocks.

What is expected comes from closed forms, from `paper_equations`, or from SciPy's solvers, never
from the plant itself.
"""

import math

import numpy as np
import pytest
import support.paper_equations as paper
from hypothesis import assume, given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from pamctl.plant.drive import drive_coupled, drive_pressure
from pamctl.plant.model import (
    MuscleParameters,
    PlantSettings,
    plant_parameters,
    settings_of,
    values_of,
)
from pamctl.plant.paper import (
    AxialForces,
    axial_forces,
    braid_lever_m,
    force_area_m2,
    slide,
    valve_flow,
    volume_m3,
)
from pamctl.plant.parameters import PlantState, vented_state
from pamctl.plant.step import advance_plant, plant_step
from pamctl.settings.resolve import resolve

P = plant_parameters(PlantSettings())
PAPER = P.paper
TICK_S = 1e-3
STEP_S = 0.5e-3
P_ATM, P_TANK = P.paper.atmospheric_pressure_pa, P.paper.tank_pressure_pa

positions_m = st.floats(0.0, 24e-3)
pressures_pa = st.floats(P_ATM, P_TANK)
commands_v = st.one_of(st.just(0.0), st.sampled_from([5.0, -5.0]), st.floats(-5.0, 5.0))
held_commands = st.lists(st.tuples(commands_v, st.integers(1, 60)), min_size=1, max_size=10)


def test_the_shipped_plant_file_holds_the_tables_of_the_paper():
    shipped = resolve(plant="paper").plant
    assert shipped == PlantSettings()
    assert shipped.parameters.model_fields_set == {*MuscleParameters.model_fields}


def run(commands: list[tuple[float, int]], state: PlantState | None = None) -> list[PlantState]:
    """Hold each command for its number of ticks, from the vented muscle."""
    states = [vented_state(P) if state is None else state]
    for command_v, ticks in commands:
        for _ in range(ticks):
            states.append(advance_plant(P, states[-1], command_v, TICK_S, STEP_S))
    return states


# --- Tables I and II, and the geometry of Eq. 1 to 3 ------------------------------------------


def test_the_default_parameters_are_tables_1_and_2():
    m = MuscleParameters()
    assert (m.mass_kg, m.damping_n_s_per_m, m.stiffness_n_per_m) == (paper.M, paper.C, paper.K)
    assert (m.rest_length_m, m.braid_length_m, m.braid_turns) == (paper.L_0, paper.B, paper.TURNS)
    assert (m.kinetic_friction_per_m, m.braid_count) == (paper.MU_K, paper.BRAIDS)
    assert m.braid_contact_area_m2 == paper.A_B
    assert (m.tank_pressure_pa, m.atmospheric_pressure_pa) == (paper.P_TANK, paper.P_ATM)
    assert (m.gas_constant_j_per_kg_k, m.temperature_k) == (paper.R, paper.T)
    assert (m.heat_capacity_ratio, m.valve_gain_m2_per_v) == (paper.GAMMA, paper.K_AV)


@given(positions_m)
def test_volume_force_area_and_lever_are_those_of_the_paper(x):
    assert volume_m3(PAPER, x) == pytest.approx(paper.volume(x), rel=1e-13)
    assert force_area_m2(PAPER, x) == pytest.approx(paper.area(x), rel=1e-12)
    theta = math.acos((paper.L_0 - x) / paper.B)
    assert braid_lever_m(PAPER, x) == pytest.approx(paper.B * theta * math.cos(theta), rel=1e-13)


# --- flow through the valve, Eq. 8 -------------------------------------------------------------


@given(pressures_pa, st.floats(-5.0, 5.0))
def test_air_flows_down_the_pressure_gradient_and_rests_without_one(pressure_pa, opening_v):
    source_pa = P_TANK if opening_v > 0.0 else P_ATM
    flow = valve_flow(PAPER, opening_v, pressure_pa)
    # Where pressures are equal but for rounding, a flow is the root of a rounding error.
    assert flow == pytest.approx(paper.inflow(opening_v, pressure_pa), rel=1e-6, abs=1e-9)
    if opening_v == 0.0 or pressure_pa == source_pa:
        assert flow == 0.0
    else:
        assert flow * (source_pa - pressure_pa) >= 0.0
    assert valve_flow(PAPER, opening_v, source_pa) == 0.0


def test_air_flows_back_into_a_source_of_lower_pressure():
    """A contracted muscle that is pulled out compresses its air above the tank's pressure."""
    assert valve_flow(PAPER, 5.0, P_TANK + 1e3) < 0.0
    assert valve_flow(PAPER, -5.0, P_ATM - 1e3) > 0.0


# --- forces, Eq. 4 and 5 -----------------------------------------------------------------------


@given(positions_m, pressures_pa)
def test_forces_are_those_of_the_paper(x, pressure_pa):
    forces = axial_forces(PAPER, x, pressure_pa)
    assert forces.drive_n == pytest.approx(paper.drive(x, pressure_pa), rel=1e-12, abs=1e-10)
    assert forces.lower_n == 0.0
    assert forces.upper_n == pytest.approx(paper.kinetic_friction(x, pressure_pa), rel=1e-12)
    assert forces.damping_up_n_s_per_m == pytest.approx(paper.C + paper.grip(pressure_pa))
    assert forces.damping_down_n_s_per_m == paper.C


# --- motion under frozen forces: exact ---------------------------------------------------------


def sticking_as_it_slides(lower_n: float, upper_n: float, **others: float) -> AxialForces:
    """The band at rest is that of motion, as without a Stribeck effect."""
    return AxialForces(
        lower_n=lower_n, upper_n=upper_n, rest_lower_n=lower_n, rest_upper_n=upper_n, **others
    )


frozen_forces = st.builds(
    sticking_as_it_slides,
    drive_n=st.floats(-500.0, 500.0),
    lower_n=st.floats(-60.0, 0.0),
    upper_n=st.floats(0.0, 60.0),
    damping_up_n_s_per_m=st.floats(100.0, 2000.0),
    damping_down_n_s_per_m=st.floats(100.0, 2000.0),
)
masses_kg = st.floats(0.01, 2.0)
speeds = st.one_of(st.just(0.0), st.floats(-1.0, 1.0))
durations_s = st.floats(1e-5, 20e-3)


def slid_by_scipy(
    forces: AxialForces, mass: float, x: float, v: float, duration: float
) -> tuple[float, float]:
    """M v' = drive - friction(v), piece by piece between stops."""
    time = 0.0
    for _ in range(3):  # a stop at the most, and then for good
        # A nanonewton outside the band moves it by less than the tolerance, and SciPy's event
        # would take its rounding for a stop.
        if v == 0.0 and forces.lower_n - 1e-9 <= forces.drive_n <= forces.upper_n + 1e-9:
            return x, 0.0
        up = v > 0.0 or (v == 0.0 and forces.drive_n > forces.upper_n)
        band = forces.upper_n if up else forces.lower_n
        damping = forces.damping_up_n_s_per_m if up else forces.damping_down_n_s_per_m

        def rates(t: float, y: list[float], band: float = band, c: float = damping) -> list[float]:
            return [y[1], (forces.drive_n - band - c * y[1]) / mass]

        def stops(t: float, y: list[float], sign: float = 1.0 if up else -1.0) -> float:
            return -sign * y[1]

        stops.terminal, stops.direction = True, 1  # type: ignore[attr-defined]
        piece = solve_ivp(
            rates, (time, duration), [x, v], "DOP853", events=stops, rtol=1e-11, atol=1e-13
        )
        time, (x, v) = float(piece.t[-1]), map(float, piece.y[:, -1])
        if piece.status == 0:
            return x, v
        v = 0.0
    raise AssertionError("frozen forces stopped the muscle more than once")


@given(frozen_forces, masses_kg, speeds, durations_s)
@examples(max_examples=60, deadline=None)
def test_a_slide_is_the_exact_motion_through_stop_and_reversal(forces, mass, v, duration):
    x_exact, v_exact = slid_by_scipy(forces, mass, 0.01, v, duration)
    x_ours, v_ours = slide(forces, mass, 0.01, v, duration)
    assert x_ours == pytest.approx(x_exact, abs=1e-11)
    assert v_ours == pytest.approx(v_exact, abs=1e-9)


@given(st.floats(0.5e-3, 23e-3), st.floats(0.01, 0.99), st.integers(1, 50))
def test_a_closed_muscle_inside_the_friction_band_does_not_creep(x, share, ticks):
    """Set-valued friction: a smoothed one would creep here."""
    # The drive is `share` of friction at this gauge pressure.
    per_gauge = paper.area(x) - share * paper.kinetic_friction(x, P_ATM + 1.0)
    gauge_pa = paper.K * x / per_gauge
    assume(gauge_pa < P_TANK - P_ATM)
    begin = PlantState(x, 0.0, P_ATM + gauge_pa)
    end = run([(0.0, ticks)], begin)[-1]
    assert (end.position_m, end.velocity_m_per_s) == (x, 0.0)
    assert end.pressure_pa == pytest.approx(begin.pressure_pa, rel=1e-13)


# --- the coupled plant ------------------------------------------------------------------------


def test_at_tank_pressure_the_muscle_rests_at_23_7_millimetres():
    """Where spring and friction balance the pull, coming from below (Eq. 4 at rest)."""

    def net(x: float) -> float:
        return paper.drive(x, P_TANK) - paper.kinetic_friction(x, P_TANK)

    balance = brentq(net, 0.0, 40e-3, xtol=1e-12)
    assert balance == pytest.approx(23.7e-3, abs=0.05e-3)
    end = run([(5.0, 3000)])[-1]
    assert end.pressure_pa == P_TANK  # the root law arrives, in finite time
    assert end.position_m == pytest.approx(balance, abs=1e-8)
    emptied = run([(-5.0, 3000)], end)[-1]
    assert emptied.position_m == pytest.approx(0.0, abs=1e-8)
    assert emptied.pressure_pa == P_ATM


@given(held_commands)
@examples(max_examples=60, deadline=None)
def test_air_that_came_in_is_the_integral_of_the_flow(commands):
    """Eq. 7 is d(PV)/dt = R T m': the balance over a whole run, flow by the paper's Psi."""
    steps = 16
    state, inflow_j = vented_state(P), 0.0
    for command_v, ticks in commands:
        for _ in range(ticks * steps):
            after = plant_step(P, state, command_v, TICK_S / steps)
            middle_pa = 0.5 * (state.pressure_pa + after.pressure_pa)
            inflow_j += TICK_S / steps * paper.R * paper.T * paper.inflow(command_v, middle_pa)
            state = after
    gained_j = state.pressure_pa * paper.volume(state.position_m) - P_ATM * paper.volume(0.0)
    assert gained_j == pytest.approx(inflow_j, abs=5e-4 * P_TANK * paper.volume(0.0))


def test_time_is_cut_into_equal_steps_of_at_most_the_given_length():
    begin = run([(5.0, 30)])[-1]
    in_three = begin
    for _ in range(3):
        in_three = plant_step(P, in_three, 2.0, TICK_S / 3)
    assert advance_plant(P, begin, 2.0, TICK_S, 0.4e-3) == in_three
    # 0.7 ms in steps of 0.1 ms are seven, although 0.7 / 0.1 is a little more in floats.
    in_seven = begin
    for _ in range(7):
        in_seven = plant_step(P, in_seven, 2.0, 0.7e-3 / 7)
    assert advance_plant(P, begin, 2.0, 0.7e-3, 0.1e-3) == in_seven


def test_a_motion_whose_squared_speed_underflows_continues():
    forces = AxialForces(1e-200, 0.0, 0.0, 100.0, 100.0, 0.0, 0.0)
    x, v = slide(forces, 0.05, 0.01, 3e-200, 1e-3)
    assert x == 0.01
    assert v > 0.0


def test_a_chamber_fills_as_its_volume_says_and_does_not_move():
    volume_m3, gain = 2e-3, 1e-6
    settings = PlantSettings(
        actuator="chamber",
        chamber_volume_m3=volume_m3,
        parameters={"valve_gain_m2_per_v": gain, "stiffness_n_per_m": 1.0, "temperature_k": 273.0},
    )
    assert settings_of(values_of(settings)) == settings
    p = plant_parameters(settings)
    driven = drive_coupled(p, np.full(101, 5.0), TICK_S)
    # While the flow is choked, V dP/dt = R T K_Av u P_tank Psi.
    choked = PAPER.specific_energy_j_per_kg * gain * 5.0 * P_TANK * PAPER.choked_flow_s_per_m
    risen_pa = driven.pressure_pa[-1] - driven.pressure_pa[0]
    assert risen_pa == pytest.approx(0.1 * choked / volume_m3, rel=1e-6)
    assert np.abs(driven.position_m).max() < 1e-6
    still = drive_pressure(p, np.full(101, 5.0), np.zeros(101), TICK_S)
    assert still.pressure_pa == pytest.approx(driven.pressure_pa, rel=1e-6)
    with pytest.raises(ValueError, match="needs chamber_volume_m3"):
        PlantSettings(actuator="chamber")


@pytest.mark.parametrize("actuator", ["muscle", "cylinder"])
def test_one_factor_on_all_pressures_forces_and_masses_moves_nothing(actuator):
    """A gauge sensor's gain is no other number than the atmosphere that is stated beside it."""
    scaled = ("atmospheric_pressure_pa", "tank_pressure_pa", "mass_kg", "damping_n_s_per_m")
    own = {"cylinder_area_m2": 8e-4, "cylinder_volume_m3": 3e-5, "stroke_m": 0.08}

    def drive(factor):
        numbers = PlantSettings().parameters.model_dump()
        numbers |= {name: factor * numbers[name] for name in (*scaled, "stiffness_n_per_m")}
        plant = PlantSettings.model_validate({
            "actuator": actuator, "parameters": numbers, **(own if actuator == "cylinder" else {}),
            "effects": {"coulomb_friction": {"force_n": 10.0 * factor}},
        })  # fmt: skip
        commands = np.repeat(np.random.default_rng(1).uniform(-5.0, 5.0, 20), 100)
        return drive_coupled(plant_parameters(plant), commands, 2.5e-3)

    one, other = drive(1.0), drive(1.015)
    np.testing.assert_allclose(other.position_m, one.position_m, atol=1e-12)
    np.testing.assert_allclose(other.pressure_pa, 1.015 * one.pressure_pa, rtol=1e-9)
