"""Air that warms and gives its heat to the walls: balances of mass and energy, by scipy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.equations import paper_equations as paper
from support.equations.effect_equations import Hidden, jet, room

from pamctl.plant.drive import drive_pressure
from pamctl.plant.parameters import parameters_of

TICK_S, GAMMA = 1e-3, 1.4
COMMAND_V = np.repeat([2.0, 0.0, -1.0, 1.5, 0.0], [60, 240, 120, 60, 320])
POSITION_M = 5e-3 + 4e-3 * np.sin(2 * np.pi * 1.3 * np.arange(len(COMMAND_V)) * TICK_S)
SPECIFIC_ENERGY = parameters_of({}).paper.specific_energy_j_per_kg  # R T_0
VALVE_GAIN = parameters_of({}).paper.valve_gain_m2_per_v


def solve_balances(wall_time_s: float) -> np.ndarray:
    """Mass and warmth T / T_0 of the air; heat flows to the walls, whatever the volume."""
    none = Hidden({})
    rest = paper.P_ATM * room(none, 0.0, paper.P_ATM) / SPECIFIC_ENERGY

    def volume_at(t: float) -> float:
        return room(none, float(np.interp(t, grid_s, POSITION_M)), paper.P_ATM)

    def rates(t: float, y: np.ndarray, volts: float) -> list[float]:
        mass, warmth = y
        volume = volume_at(t)
        slope = (volume_at(t + 1e-6) - volume_at(t - 1e-6)) / 2e-6
        pressure = mass * SPECIFIC_ENERGY * warmth / volume
        area = VALVE_GAIN * abs(volts)
        comes = area * jet(none, paper.P_TANK, pressure) if volts > 0.0 else 0.0
        leaves = area * jet(none, pressure, paper.P_ATM) / np.sqrt(warmth) if volts < 0.0 else 0.0
        # In units of c_v T_0: enthalpy in and out, work, and heat to the walls.
        energy = GAMMA * (comes - leaves * warmth)
        energy -= (GAMMA - 1.0) * pressure * slope / SPECIFIC_ENERGY
        energy -= rest * (warmth - 1.0) / wall_time_s
        return [comes - leaves, (energy - warmth * (comes - leaves)) / mass]

    grid_s = np.arange(len(COMMAND_V)) * TICK_S
    y = np.array([paper.P_ATM * volume_at(0.0) / SPECIFIC_ENERGY, 1.0])
    shown = []
    for k, t in enumerate(grid_s):
        shown.append(y[0] * SPECIFIC_ENERGY * y[1] / volume_at(t))
        volts = float(COMMAND_V[k])
        solved = solve_ivp(rates, (t, t + TICK_S), y, "LSODA", args=(volts,), rtol=1e-9, atol=1e-14)
        y = solved.y[:, -1]
    return np.array(shown)


@pytest.mark.parametrize("wall_time_s", [0.01, 0.15, 5.0])
def test_heat_to_the_walls_solves_the_balances_of_mass_and_energy(wall_time_s: float) -> None:
    exact_pa = solve_balances(wall_time_s)
    values = {"polytropic.exponent": GAMMA, "polytropic.wall_time_s": wall_time_s}

    def error_pa(steps: int) -> float:
        ours = drive_pressure(parameters_of(values), COMMAND_V, POSITION_M, TICK_S, steps=steps)
        return float(np.abs(ours.pressure_pa - exact_pa).max())

    fixed = drive_pressure(
        parameters_of({"polytropic.exponent": GAMMA}), COMMAND_V, POSITION_M, TICK_S
    )
    assert np.abs(fixed.pressure_pa - exact_pa).max() > 1000.0
    assert error_pa(2) < 250.0
    assert error_pa(32) < 15.0


def test_walls_that_take_all_heat_at_once_leave_the_papers_isothermal_air() -> None:
    paper_pa = drive_pressure(parameters_of({}), COMMAND_V, POSITION_M, TICK_S, steps=8).pressure_pa
    values = {"polytropic.exponent": GAMMA, "polytropic.wall_time_s": 1e-7}
    quick = drive_pressure(parameters_of(values), COMMAND_V, POSITION_M, TICK_S, steps=8)
    assert quick.pressure_pa == pytest.approx(paper_pa, abs=2.0)
