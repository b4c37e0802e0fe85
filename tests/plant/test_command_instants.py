"""A command acts some time after its sample: the drives cut their intervals there."""

from __future__ import annotations

import math

import numpy as np
import pytest
import support.paper_equations as paper
from scipy.integrate import solve_ivp

from pamctl.plant.drive import build_grid, build_steps, drive_coupled, drive_pressure
from pamctl.plant.parameters import parameters_of
from pamctl.plant.simulated import SimulatedPlant

TICK_S = 1e-3
TICKS = 300
PAPER = parameters_of({})
VALVE_109 = parameters_of({"valve_spool.time_constant_s": 1.46e-3})
RANDOM = np.random.default_rng(5)
# The muscle is never quite full or empty: there a step of the integrator is less exact.
COMMAND_V = np.where(np.arange(TICKS) % 90 < 45, 1.6, -1.4) + RANDOM.normal(0.0, 0.5, TICKS)
POSITION_M = 8e-3 - 8e-3 * np.cos(2 * np.pi * 4 * TICK_S * np.arange(TICKS))
LATE_S = RANDOM.uniform(2e-5, 9e-4, TICKS)

plants = pytest.mark.parametrize("p", [PAPER, VALVE_109], ids=["paper", "valve109"])


def pressure_of_jumps(changes_s: np.ndarray, samples_s: np.ndarray) -> np.ndarray:
    """Solve the paper's pressure equation by SciPy; command k begins at `changes_s[k]`, exactly."""
    speeds = np.diff(POSITION_M) / np.diff(samples_s)
    cuts = np.unique(np.concatenate([samples_s, changes_s[changes_s < samples_s[-1]]]))
    cuts = cuts[cuts >= 0.0]
    found, pressure_pa = {0.0: paper.P_ATM}, paper.P_ATM
    for begin, end in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
        middle = 0.5 * (begin + end)
        u = COMMAND_V[max(int(np.searchsorted(changes_s, middle)) - 1, 0)]
        k = int(np.searchsorted(samples_s, middle)) - 1

        def rate(t: float, y: np.ndarray, u: float = u, k: int = k) -> list[float]:
            x = POSITION_M[k] + speeds[k] * (t - samples_s[k])
            return [paper.pressure_rate(u, x, speeds[k], float(y[0]))]

        piece = solve_ivp(
            rate, (begin, end), [pressure_pa], "LSODA", rtol=1e-9, atol=1e-3, max_step=end - begin
        )
        pressure_pa = float(piece.y[0, -1])
        found[end] = pressure_pa
    return np.array([found[t] for t in samples_s.tolist()])


def test_the_pressure_solves_the_equation_whose_command_jumps_at_the_exact_instants() -> None:
    dt_s = np.full(TICKS - 1, TICK_S)
    dt_s[[70, 150, 151]] = 4e-3  # missed ticks
    late_s = LATE_S.copy()
    late_s[150] = 3.3e-3
    samples_s = np.concatenate([[0.0], np.cumsum(dt_s)])
    exact_pa = pressure_of_jumps(samples_s + late_s, samples_s)

    def error_pa(steps: int, acts_after_s: np.ndarray | None) -> float:
        ours = drive_pressure(
            PAPER, COMMAND_V, POSITION_M, dt_s, steps=steps, acts_after_s=acts_after_s
        )
        return float(np.abs(ours.pressure_pa - exact_pa).max())

    assert error_pa(2, None) > 1000.0
    assert error_pa(2, late_s) < 60.0
    assert error_pa(16, late_s) < 2.0


@plants
def test_the_coupled_drive_is_the_rig_whose_command_changes_between_the_samples(p) -> None:
    late_s = 0.48 * LATE_S  # so that both cut the two parts into as many steps
    driven = drive_coupled(p, COMMAND_V, TICK_S, acts_after_s=late_s)
    plant, acting = SimulatedPlant(p), float(COMMAND_V[0])
    for k in range(TICKS):
        assert plant.position_m == pytest.approx(driven.true_position_m[k], rel=1e-9, abs=1e-13)
        assert plant.pressure_pa == pytest.approx(driven.true_pressure_pa[k], rel=1e-9)
        plant.advance(acting, late_s[k])
        acting = float(COMMAND_V[k])
        plant.advance(acting, TICK_S - late_s[k])


@plants
def test_commands_that_act_at_once_are_today_s_drive_to_the_bit(p) -> None:
    plain = np.array(drive_coupled(p, COMMAND_V, TICK_S))
    for zero in (0.0, np.zeros(TICKS), None):
        again = np.array(drive_coupled(p, COMMAND_V, TICK_S, acts_after_s=zero))
        np.testing.assert_array_equal(again, plain)


def test_a_whole_tick_of_delay_is_the_command_shifted_by_one() -> None:
    shifted = np.concatenate([COMMAND_V[:1], COMMAND_V[:-1]])
    late = drive_coupled(PAPER, COMMAND_V, TICK_S, acts_after_s=TICK_S)
    expected = drive_coupled(PAPER, shifted, TICK_S)
    np.testing.assert_allclose(np.array(late), np.array(expected), rtol=1e-9, atol=1e-13)


def test_a_command_that_acted_before_its_sample_divides_the_interval_before_it() -> None:
    """A card put it out at an edge that the loop missed."""
    dt_s = np.full(TICKS - 1, TICK_S)
    dt_s[100] = 3e-3
    acts_s = np.zeros(TICKS)
    acts_s[101] = -2e-3
    long = drive_coupled(PAPER, COMMAND_V, dt_s, acts_after_s=acts_s)
    every = np.insert(COMMAND_V, 101, [COMMAND_V[101]] * 2)
    expected = np.delete(np.array(drive_coupled(PAPER, every, TICK_S)), [101, 102], axis=1)
    np.testing.assert_allclose(np.array(long), expected, rtol=1e-9, atol=1e-13)


def test_the_delay_of_the_plant_comes_on_top() -> None:
    both = parameters_of({"command_delay.delay_s": 1.2e-3})
    ours = drive_pressure(both, COMMAND_V, POSITION_M, TICK_S, acts_after_s=LATE_S, steps=16)
    samples_s = np.arange(TICKS) * TICK_S
    exact_pa = pressure_of_jumps(samples_s + LATE_S + 1.2e-3, samples_s)
    assert np.abs(ours.pressure_pa - exact_pa).max() < 2.0


def test_a_command_that_a_later_one_overtakes_never_acts() -> None:
    acts_s = np.full(TICKS, 1e-4)
    acts_s[40] = 1.5e-3
    ours = drive_coupled(PAPER, COMMAND_V, TICK_S, acts_after_s=acts_s)
    replaced = np.concatenate([COMMAND_V[:40], COMMAND_V[39:40], COMMAND_V[41:]])
    late_s = np.full(TICKS, 1e-4)
    late_s[41] = 5e-4
    expected = drive_coupled(PAPER, replaced, TICK_S, acts_after_s=late_s)
    np.testing.assert_allclose(ours.pressure_pa, expected.pressure_pa, rtol=1e-6)
    np.testing.assert_allclose(ours.position_m, expected.position_m, rtol=0, atol=1e-9)


def test_a_short_delay_costs_one_step_a_tick_and_the_steps_keep_their_length() -> None:
    grid = build_grid(TICK_S, TICKS, acts_after_s=1e-4)
    assert len(grid.step_s) == 3 * (TICKS - 1)
    assert grid.step_s.max() < 0.55e-3
    assert math.isclose(grid.ends_s[-1], (TICKS - 1) * TICK_S)
    steps = build_steps(PAPER, COMMAND_V, grid)
    assert steps.command_v[:6].tolist() == [COMMAND_V[0]] * 4 + [COMMAND_V[1]] * 2


def test_half_of_the_ticks_missed_does_not_make_the_steps_longer() -> None:
    dt_s = np.tile([1e-3, 3e-3, 3e-3], TICKS)
    assert build_grid(dt_s, len(dt_s) + 1).step_s.max() < 0.56e-3


@pytest.mark.parametrize(
    ("acts_after_s", "complaint"),
    [([1e-4], "where the command has 3"), ([0.0, math.nan, 0.0], "acts_after_s: sample 1")],
)
def test_invalid_instants_are_refused(acts_after_s, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        drive_coupled(PAPER, [0.0] * 3, TICK_S, acts_after_s=acts_after_s)


def test_a_grid_takes_no_other_instants() -> None:
    grid = build_grid(TICK_S, 3)
    with pytest.raises(ValueError, match="a grid has its own"):
        drive_coupled(PAPER, [0.0] * 3, grid, acts_after_s=1e-4)


@pytest.mark.parametrize("late_s", [None, 3e-4])
def test_a_record_starts_with_the_valve_in_the_command_before_it(late_s: float | None) -> None:
    """A spool needs time from where it was, and the first command comes late."""
    delay_s = 1.4e-3
    p = parameters_of(
        {
            "valve_spool.time_constant_s": 1.46e-3,
            "valve_hysteresis.width_v": 0.2,
            "command_delay.delay_s": delay_s,
        }
    )
    held = np.concatenate([np.full(200, -5.0), COMMAND_V])
    held_m = np.concatenate([np.full(200, POSITION_M[0]), POSITION_M])
    whole = drive_pressure(p, held, held_m, TICK_S, acts_after_s=late_s).pressure_pa[200:]
    known = build_grid(TICK_S, TICKS, acts_after_s=late_s, held_v=-5.0)
    unknown = build_grid(TICK_S, TICKS, acts_after_s=late_s)
    ours = drive_pressure(p, COMMAND_V, POSITION_M, known).pressure_pa
    assert np.abs(ours - whole).max() < 20.0
    assert np.abs(drive_pressure(p, COMMAND_V, POSITION_M, unknown).pressure_pa - whole).max() > 2e3
    coupled = drive_coupled(p, COMMAND_V, known).pressure_pa
    before = drive_coupled(p, held, TICK_S, acts_after_s=late_s).pressure_pa[200:]
    assert np.abs(coupled - before).max() < 20.0


def test_the_command_before_changes_nothing_where_the_first_acts_at_once() -> None:
    known = build_grid(TICK_S, TICKS, held_v=-5.0)
    plain = drive_coupled(PAPER, COMMAND_V, TICK_S)
    np.testing.assert_array_equal(np.array(drive_coupled(PAPER, COMMAND_V, known)), np.array(plain))
