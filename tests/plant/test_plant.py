"""The plant's physics: geometry, flow, friction, conservation, and its two blocks.

What is expected comes from closed forms, from `paper_equations`, or from SciPy's solvers, never
from the plant itself.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import support.paper_equations as paper
from hypothesis import assume, given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp
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
    mechanics_step,
    middle_pressure_pa,
    orifice_flow,
    pressure_step,
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


def test_the_shipped_plant_file_holds_the_tables_of_the_paper() -> None:
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


def test_the_default_parameters_are_tables_1_and_2() -> None:
    m = MuscleParameters()
    assert (m.mass_kg, m.damping_n_s_per_m, m.stiffness_n_per_m) == (paper.M, paper.C, paper.K)
    assert (m.rest_length_m, m.braid_length_m, m.braid_turns) == (paper.L_0, paper.B, paper.TURNS)
    assert (m.kinetic_friction_per_m, m.braid_count) == (paper.MU_K, paper.BRAIDS)
    assert m.braid_contact_area_m2 == paper.A_B
    assert (m.tank_pressure_pa, m.atmospheric_pressure_pa) == (paper.P_TANK, paper.P_ATM)
    assert (m.gas_constant_j_per_kg_k, m.temperature_k) == (paper.R, paper.T)
    assert (m.heat_capacity_ratio, m.valve_gain_m2_per_v) == (paper.GAMMA, paper.K_AV)


@given(positions_m)
def test_volume_force_area_and_lever_are_those_of_the_paper(x: float) -> None:
    assert volume_m3(PAPER, x) == pytest.approx(paper.volume(x), rel=1e-13)
    assert force_area_m2(PAPER, x) == pytest.approx(paper.area(x), rel=1e-12)
    theta = math.acos((paper.L_0 - x) / paper.B)
    assert braid_lever_m(PAPER, x) == pytest.approx(paper.B * theta * math.cos(theta), rel=1e-13)


@given(positions_m)
def test_the_force_area_is_the_slope_of_the_volume(x: float) -> None:
    """Virtual work: F = -P dV/dL = P dV/dx. The volume is a cubic, so five points are exact."""
    h = 1e-3
    slope = (
        volume_m3(PAPER, x - 2 * h)
        - 8 * volume_m3(PAPER, x - h)
        + 8 * volume_m3(PAPER, x + h)
        - volume_m3(PAPER, x + 2 * h)
    ) / (12 * h)
    assert force_area_m2(PAPER, x) == pytest.approx(slope, rel=1e-10)


# --- flow through the valve, Eq. 8 -------------------------------------------------------------


def nozzle_flow(upstream_pa: float, downstream_pa: float) -> float:
    """Flow per area from the energy balance, rather than from the formula for Psi.

    Air expands reversibly down to the throat's pressure: h = cp T, v = sqrt(2 (h_0 - h)), flow
    = density times v. A throat's pressure is the downstream one, unless the flow is choked:
    then it is the one of the greatest flow.
    """
    cp = paper.GAMMA / (paper.GAMMA - 1) * paper.R

    def flow(throat_pa: float) -> float:
        ratio = throat_pa / upstream_pa
        temperature = paper.T * ratio ** ((paper.GAMMA - 1) / paper.GAMMA)
        speed = math.sqrt(2 * cp * max(0.0, paper.T - temperature))
        return throat_pa / (paper.R * temperature) * speed

    sonic_pa = upstream_pa * paper.CRITICAL_RATIO
    return flow(max(downstream_pa, sonic_pa))


@given(st.floats(P_ATM, P_TANK), st.floats(0.01, 0.9999))
def test_psi_is_the_flow_of_an_isentropic_nozzle(upstream_pa: float, ratio: float) -> None:
    expected = nozzle_flow(upstream_pa, ratio * upstream_pa)
    # Near 1 both take the root of a difference of nearly equal numbers.
    assert orifice_flow(PAPER, upstream_pa, ratio * upstream_pa) == pytest.approx(
        expected, rel=1e-10
    )
    assert paper.psi(upstream_pa, ratio * upstream_pa) == pytest.approx(expected, rel=1e-10)


def test_the_flow_is_choked_at_the_speed_of_sound() -> None:
    """And the critical ratio is where the flow is greatest: 0.528 for air."""
    assert pytest.approx(0.5283, abs=1e-4) == P.paper.critical_ratio
    temperature = paper.T * P.paper.critical_ratio ** ((paper.GAMMA - 1) / paper.GAMMA)
    sound = math.sqrt(paper.GAMMA * paper.R * temperature)
    density = P_TANK * P.paper.critical_ratio / (paper.R * temperature)
    assert orifice_flow(PAPER, P_TANK, 0.0) == pytest.approx(density * sound, rel=1e-12)


@given(pressures_pa, st.floats(-5.0, 5.0))
def test_air_flows_down_the_pressure_gradient_and_rests_without_one(
    pressure_pa: float, opening_v: float
) -> None:
    source_pa = P_TANK if opening_v > 0.0 else P_ATM
    flow = valve_flow(PAPER, opening_v, pressure_pa)
    # Where pressures are equal but for rounding, a flow is the root of a rounding error.
    assert flow == pytest.approx(paper.inflow(opening_v, pressure_pa), rel=1e-6, abs=1e-9)
    if opening_v == 0.0 or pressure_pa == source_pa:
        assert flow == 0.0
    else:
        assert flow * (source_pa - pressure_pa) >= 0.0
    assert valve_flow(PAPER, opening_v, source_pa) == 0.0


def test_air_flows_back_into_a_source_of_lower_pressure() -> None:
    """A contracted muscle that is pulled out compresses its air above the tank's pressure."""
    assert valve_flow(PAPER, 5.0, P_TANK + 1e3) < 0.0
    assert valve_flow(PAPER, -5.0, P_ATM - 1e3) > 0.0


# --- forces, Eq. 4 and 5 -----------------------------------------------------------------------


@given(positions_m, pressures_pa)
def test_forces_are_those_of_the_paper(x: float, pressure_pa: float) -> None:
    forces = axial_forces(PAPER, x, pressure_pa)
    assert forces.drive_n == pytest.approx(paper.drive(x, pressure_pa), rel=1e-12, abs=1e-10)
    assert forces.lower_n == 0.0
    assert forces.upper_n == pytest.approx(paper.kinetic_friction(x, pressure_pa), rel=1e-12)
    assert forces.damping_up_n_s_per_m == pytest.approx(paper.C + paper.grip(pressure_pa))
    assert forces.damping_down_n_s_per_m == paper.C


def test_an_empty_muscle_pulls_with_its_spring_only() -> None:
    """Eq. 3 takes gauge pressure: with absolute pressure it would rest at 11.6 mm."""
    forces = axial_forces(PAPER, 10e-3, P_ATM)
    assert forces.drive_n == pytest.approx(-paper.K * 10e-3, rel=1e-12)
    assert (forces.lower_n, forces.upper_n) == (0.0, 0.0)


def test_friction_is_47_newtons_at_340_kilopascals() -> None:
    """And 55 N when contracted, of a pull of 475 N: in millimetres it would be 47 kN."""
    assert axial_forces(PAPER, 0.0, P_ATM + 340e3).upper_n == pytest.approx(46.6, abs=0.1)
    assert axial_forces(PAPER, 23.7e-3, P_ATM + 340e3).upper_n == pytest.approx(54.6, abs=0.1)


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
def test_a_slide_is_the_exact_motion_through_stop_and_reversal(
    forces: AxialForces, mass: float, v: float, duration: float
) -> None:
    x_exact, v_exact = slid_by_scipy(forces, mass, 0.01, v, duration)
    x_ours, v_ours = slide(forces, mass, 0.01, v, duration)
    assert x_ours == pytest.approx(x_exact, abs=1e-11)
    assert v_ours == pytest.approx(v_exact, abs=1e-9)


@given(frozen_forces, masses_kg, st.floats(1e-3, 1.0))
def test_a_slide_against_friction_stops_and_reverses(
    forces: AxialForces, mass: float, v: float
) -> None:
    """The three ends of an upward motion: terminal speed, rest, or the way back."""
    _, v_end = slide(forces, mass, 0.0, v, 1e3)
    if forces.drive_n > forces.upper_n:
        terminal = (forces.drive_n - forces.upper_n) / forces.damping_up_n_s_per_m
    elif forces.drive_n < forces.lower_n:
        terminal = (forces.drive_n - forces.lower_n) / forces.damping_down_n_s_per_m
    else:
        terminal = 0.0
    assert v_end == pytest.approx(terminal, rel=1e-12)


@given(positions_m, pressures_pa)
def test_a_resting_muscle_stays_to_the_bit_while_the_drive_is_within_friction(
    x: float, pressure_pa: float
) -> None:
    net = paper.drive(x, pressure_pa)
    friction = paper.kinetic_friction(x, pressure_pa)
    end_x, end_v = mechanics_step(PAPER, x, 0.0, pressure_pa, STEP_S)
    if 1e-9 < net < friction - 1e-9:
        assert (end_x, end_v) == (x, 0.0)
    elif net > friction + 1e-6:
        assert end_x > x
        assert end_v > 0.0
    elif net < -1e-6:
        assert end_x < x
        assert end_v < 0.0


@given(st.floats(0.5e-3, 23e-3), st.floats(0.01, 0.99), st.integers(1, 50))
def test_a_closed_muscle_inside_the_friction_band_does_not_creep(
    x: float, share: float, ticks: int
) -> None:
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


def test_the_vented_muscle_is_at_rest_and_stays_so() -> None:
    begin = vented_state(P)
    assert begin[:3] == (0.0, 0.0, paper.P_ATM)
    for command_v in (0.0, -5.0):
        end = run([(command_v, 200)])[-1]
        assert (end.position_m, end.velocity_m_per_s, end.pressure_pa) == begin[:3]


def test_at_tank_pressure_the_muscle_rests_at_23_7_millimetres() -> None:
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
@examples(max_examples=40, deadline=None)
def test_a_closed_valve_keeps_the_air(commands: list[tuple[float, int]]) -> None:
    """P V = m R T stays, while the muscle still moves."""
    begin = run(commands)[-1]
    states = run([(0.0, 200)], begin)
    energy = begin.pressure_pa * paper.volume(begin.position_m)
    for state in states:
        assert state.pressure_pa * paper.volume(state.position_m) == pytest.approx(
            energy, rel=1e-12
        )


def test_the_muscle_moves_while_the_valve_is_closed() -> None:
    """Counter-check of the test above: 40 ms of filling leave the muscle far from its balance."""
    begin = run([(5.0, 40)])[-1]
    states = run([(0.0, 200)], begin)
    assert states[-1].position_m - begin.position_m > 1e-3
    assert begin.pressure_pa - states[-1].pressure_pa > 5e3


@given(held_commands)
@examples(max_examples=60, deadline=None)
def test_air_that_came_in_is_the_integral_of_the_flow(commands: list[tuple[float, int]]) -> None:
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


@given(held_commands)
@examples(max_examples=60, deadline=None)
def test_pressure_stays_between_atmosphere_and_tank(commands: list[tuple[float, int]]) -> None:
    """No valve can lead out of these bounds, and neither can the muscle's own motion.

    It contracts only under pressure, so it never draws a vacuum; and it is never longer
    contracted than at the tank's pressure, so compressing its air cannot exceed that. The
    allowance is for P V / V, which rounds: no step may jump past its source at all.
    """
    for state in run(commands):
        assert P_ATM - 1e-9 <= state.pressure_pa <= P_TANK + 1e-9
        assert -1e-9 <= state.position_m <= 23.8e-3


def test_pressing_a_full_closed_muscle_raises_its_pressure() -> None:
    """The sign of the P V' term: shortening makes room, lengthening takes it."""
    longer = pressure_step(PAPER, 300e3, 300e3, 0.0, 10e-3, 9e-3, STEP_S)
    shorter = pressure_step(PAPER, 300e3, 300e3, 0.0, 10e-3, 11e-3, STEP_S)
    assert longer == pytest.approx(300e3 * paper.volume(10e-3) / paper.volume(9e-3), rel=1e-13)
    assert shorter < 300e3 < longer


def test_filling_a_held_muscle_takes_the_time_of_the_choked_flow() -> None:
    """Pressure against quadrature: t = V / (R T) integral of dP / m'(P)."""
    x, opening_v = 5e-3, 1.0
    pressure_pa, steps = P_ATM, 200
    for _ in range(steps):
        middle_pa = middle_pressure_pa(PAPER, pressure_pa, opening_v, x, x, TICK_S)
        pressure_pa = pressure_step(PAPER, pressure_pa, middle_pa, opening_v, x, x, TICK_S)
    assert paper.CRITICAL_RATIO * P_TANK < pressure_pa < 0.99 * P_TANK
    needed_s, _ = quad(
        lambda at: paper.volume(x) / (paper.R * paper.T * paper.inflow(opening_v, at)),
        P_ATM,
        pressure_pa,
        points=[paper.CRITICAL_RATIO * P_TANK],
        epsrel=1e-11,
    )
    assert needed_s == pytest.approx(steps * TICK_S, rel=1e-5)


def test_time_is_cut_into_equal_steps_of_at_most_the_given_length() -> None:
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


def test_a_motion_whose_squared_speed_underflows_continues() -> None:
    forces = AxialForces(1e-200, 0.0, 0.0, 100.0, 100.0, 0.0, 0.0)
    x, v = slide(forces, 0.05, 0.01, 3e-200, 1e-3)
    assert x == 0.01
    assert v > 0.0


def test_a_chamber_fills_as_its_volume_says_and_does_not_move() -> None:
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
