"""The plant driven by arrays: block by block, together, and by commands that act in between."""

import math
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
import support.paper_equations as paper
from scipy.integrate import solve_ivp

from pamctl.plant import drive
from pamctl.plant.drive import Restarts, drive_coupled, drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters, settings_of, values_of
from pamctl.plant.parameters import parameters_of, vented_state
from pamctl.plant.sample_grid import build_grid, build_steps
from pamctl.plant.simulated import SimulatedPlant
from pamctl.plant.step import plant_step

TICK_S = 1e-3
SQUARE = np.array([5.0 if i % 400 < 200 else -5.0 for i in range(800)])
SMALL = np.array([0.0 if i % 400 > 300 else 1.5 * math.sin(0.02 * i) for i in range(1200)])
PAPER = plant_parameters(PlantSettings())
VALVE_109 = parameters_of({"valve_spool.time_constant_s": 1.46e-3})

plants = pytest.mark.parametrize("p", [PAPER, VALVE_109], ids=["paper", "valve109"])
commands = pytest.mark.parametrize("command_v", [SQUARE, SMALL], ids=["square", "small"])


@plants
@commands
def test_the_coupled_drive_is_the_simulated_rig_sampled_before_each_command(p, command_v):
    driven = drive_coupled(p, command_v, TICK_S)
    plant = SimulatedPlant(p)
    for k, command in enumerate(command_v.tolist()):
        assert (driven.true_position_m[k], driven.true_pressure_pa[k]) == (
            plant.position_m,
            plant.pressure_pa,
        )
        plant.advance(command, TICK_S)


@plants
@commands
def test_each_block_driven_by_the_others_signal_follows_the_coupled_plant(p, command_v):
    """Between samples the other's signal is linear: an error of second order in the tick."""
    coupled = drive_coupled(p, command_v, TICK_S, steps=8)
    pressure = drive_pressure(p, command_v, coupled.position_m, TICK_S, steps=8)
    mechanics = drive_mechanics(p, coupled.pressure_pa, TICK_S, steps=8)
    assert np.abs(pressure.pressure_pa - coupled.pressure_pa).max() < 60.0
    assert np.abs(mechanics.position_m - coupled.position_m).max() < 4e-6
    finer = drive_coupled(p, command_v.repeat(4), TICK_S / 4)
    alone = drive_pressure(p, command_v.repeat(4), finer.position_m, TICK_S / 4)
    assert np.abs(alone.pressure_pa - finer.pressure_pa).max() < 10.0


def test_jitter_adds_no_step_and_an_interval_twice_as_long_has_twice_as_many():
    dt_s = np.full(len(SQUARE) - 1, TICK_S)
    dt_s[50] = 1.04e-3
    dt_s[60] = 2e-3
    driven = drive_coupled(PAPER, SQUARE, dt_s)
    state = vented_state(PAPER)
    for k, interval in enumerate(dt_s.tolist()):
        steps = 4 if k == 60 else 2
        for _ in range(steps):
            state = plant_step(PAPER, state, float(SQUARE[k]), interval / steps)
        assert driven.true_position_m[k + 1] == state.position_m


@pytest.mark.parametrize(
    ("command_v", "dt_s", "complaint"),
    [
        ([[1.0]], 1e-3, "shape"),
        ([1.0, math.nan], 1e-3, "sample 1"),
        ([1.0, 2.0], [1e-3, 1e-3, 1e-3], "one for each interval"),
        ([1.0, 2.0], [0.0], "longer than 0"),
    ],
)
def test_invalid_arrays_are_refused(command_v, dt_s, complaint):
    with pytest.raises(ValueError, match=complaint):
        drive_coupled(PAPER, command_v, dt_s)
    with pytest.raises(ValueError, match="where the command has 3"):
        drive_pressure(PAPER, [0.0] * 3, [0.0] * 2, 1e-3)


def test_a_restart_undoes_the_scale_of_the_encoder_in_position_and_velocity():
    p = parameters_of(
        {"actuator": 1.0, "mass_kg": 95.0, "stiffness_n_per_m": 0.0, "encoder_scale.scale": 1.1}
    )
    again = Restarts(np.array([5]), np.array([0.22]), np.array([0.55]))
    moved = drive_mechanics(p, np.full(10, 101.3e3), TICK_S, restarts=again)
    assert moved.position_m[5] == pytest.approx(0.22)
    assert moved.true_position_m[5] == pytest.approx(0.2)
    assert moved.velocity_m_per_s[5] == pytest.approx(0.5)


# --- a plant as a flat mapping -----------------------------------------------------------------


def test_a_flat_mapping_and_a_plant_file_are_equivalent():
    values = {"stiffness_n_per_m": 9500.0, "valve_spool.time_constant_s": 1e-3}
    settings = settings_of(values)
    assert settings.parameters.stiffness_n_per_m == 9500.0
    assert plant_parameters(settings) == parameters_of(values)
    assert values_of(settings).items() >= values.items()
    neutral = settings_of({"valve_spool.time_constant_s": 0.0, "valve_spool.damping_ratio": 0.5})
    assert neutral == PlantSettings()


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(KeyError, match=r"did you mean valve_spool\.time_constant_s"):
        parameters_of({"valve_spool.time_constant": 1e-3})


# --- instants of commands ------------------------------------------------------------------------

TICKS = 300
RANDOM = np.random.default_rng(5)
# The muscle is never quite full or empty: there a step of the integrator is less exact.
COMMAND_V = np.where(np.arange(TICKS) % 90 < 45, 1.6, -1.4) + RANDOM.normal(0.0, 0.5, TICKS)
POSITION_M = 8e-3 - 8e-3 * np.cos(2 * np.pi * 4 * TICK_S * np.arange(TICKS))
LATE_S = RANDOM.uniform(2e-5, 9e-4, TICKS)


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


def test_the_pressure_solves_the_equation_whose_command_jumps_at_the_exact_instants():
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
def test_the_coupled_drive_is_the_rig_whose_command_changes_between_the_samples(p):
    late_s = 0.48 * LATE_S  # so that both cut the two parts into as many steps
    driven = drive_coupled(p, COMMAND_V, TICK_S, acts_after_s=late_s)
    plant, acting = SimulatedPlant(p), float(COMMAND_V[0])
    for k in range(TICKS):
        assert plant.position_m == pytest.approx(driven.true_position_m[k], rel=1e-9, abs=1e-13)
        assert plant.pressure_pa == pytest.approx(driven.true_pressure_pa[k], rel=1e-9)
        plant.advance(acting, late_s[k])
        acting = float(COMMAND_V[k])
        plant.advance(acting, TICK_S - late_s[k])


def test_a_command_that_acted_before_its_sample_divides_the_interval_before_it():
    """A card put it out at an edge that the loop missed."""
    dt_s = np.full(TICKS - 1, TICK_S)
    dt_s[100] = 3e-3
    acts_s = np.zeros(TICKS)
    acts_s[101] = -2e-3
    long = drive_coupled(PAPER, COMMAND_V, dt_s, acts_after_s=acts_s)
    every = np.insert(COMMAND_V, 101, [COMMAND_V[101]] * 2)
    expected = np.delete(np.array(drive_coupled(PAPER, every, TICK_S)), [101, 102], axis=1)
    np.testing.assert_allclose(np.array(long), expected, rtol=1e-9, atol=1e-13)


def test_the_delay_of_the_plant_comes_on_top():
    both = parameters_of({"command_delay.delay_s": 1.2e-3})
    ours = drive_pressure(both, COMMAND_V, POSITION_M, TICK_S, acts_after_s=LATE_S, steps=16)
    samples_s = np.arange(TICKS) * TICK_S
    exact_pa = pressure_of_jumps(samples_s + LATE_S + 1.2e-3, samples_s)
    assert np.abs(ours.pressure_pa - exact_pa).max() < 2.0


def test_a_command_that_a_later_one_overtakes_never_acts():
    acts_s = np.full(TICKS, 1e-4)
    acts_s[40] = 1.5e-3
    ours = drive_coupled(PAPER, COMMAND_V, TICK_S, acts_after_s=acts_s)
    replaced = np.concatenate([COMMAND_V[:40], COMMAND_V[39:40], COMMAND_V[41:]])
    late_s = np.full(TICKS, 1e-4)
    late_s[41] = 5e-4
    expected = drive_coupled(PAPER, replaced, TICK_S, acts_after_s=late_s)
    np.testing.assert_allclose(ours.pressure_pa, expected.pressure_pa, rtol=1e-6)
    np.testing.assert_allclose(ours.position_m, expected.position_m, rtol=0, atol=1e-9)


def test_a_short_delay_costs_one_step_a_tick_and_the_steps_keep_their_length():
    grid = build_grid(TICK_S, TICKS, acts_after_s=1e-4)
    assert len(grid.step_s) == 3 * (TICKS - 1)
    assert grid.step_s.max() < 0.55e-3
    assert math.isclose(grid.ends_s[-1], (TICKS - 1) * TICK_S)
    steps = build_steps(PAPER, COMMAND_V, grid)
    assert steps.command_v[:6].tolist() == [COMMAND_V[0]] * 4 + [COMMAND_V[1]] * 2


@pytest.mark.parametrize(
    ("acts_after_s", "complaint"),
    [([1e-4], "where the command has 3"), ([0.0, math.nan, 0.0], "acts_after_s: sample 1")],
)
def test_invalid_instants_are_refused(acts_after_s, complaint):
    with pytest.raises(ValueError, match=complaint):
        drive_coupled(PAPER, [0.0] * 3, TICK_S, acts_after_s=acts_after_s)


def test_a_grid_takes_no_other_instants():
    grid = build_grid(TICK_S, 3)
    with pytest.raises(ValueError, match="a grid has its own"):
        drive_coupled(PAPER, [0.0] * 3, grid, acts_after_s=1e-4)


@pytest.mark.parametrize("late_s", [None, 3e-4])
def test_a_record_starts_with_the_valve_in_the_command_before_it(late_s):
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


@plants
def test_the_compiled_drives_are_their_plain_twins_to_the_bit(p, monkeypatch):
    dt_s = np.full(len(SMALL) - 1, TICK_S)
    dt_s[100::97] *= 2.0
    coupled = drive_coupled(p, SMALL, dt_s)
    pressure = drive_pressure(p, SMALL, coupled.position_m, dt_s)
    mechanics = drive_mechanics(p, coupled.pressure_pa, dt_s)
    monkeypatch.setattr(
        drive, "machine", lambda kernel: SimpleNamespace(fill_until_it_fails=kernel)
    )
    for plain, compiled in (
        (drive_coupled(p, SMALL, dt_s), coupled),
        (drive_pressure(p, SMALL, coupled.position_m, dt_s), pressure),
        (drive_mechanics(p, coupled.pressure_pa, dt_s), mechanics),
    ):
        np.testing.assert_array_equal(np.array(plain), np.array(compiled))


def test_threads_may_drive_records_at_once(monkeypatch):
    monkeypatch.setattr(drive, "_MOST_INTERPOLATED_BYTES", 2_000_000)
    often = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    grid = build_grid(TICK_S, TICKS)
    alone = drive_pressure(PAPER, COMMAND_V, POSITION_M, grid).pressure_pa

    def drive_copies(_: int) -> None:
        for _ in range(60):
            driven = drive_pressure(PAPER, COMMAND_V, POSITION_M.copy(), grid)
            np.testing.assert_array_equal(driven.pressure_pa, alone)

    try:
        with ThreadPoolExecutor(8) as threads:
            list(threads.map(drive_copies, range(8)))
    finally:
        sys.setswitchinterval(often)
