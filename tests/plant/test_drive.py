"""The plant driven by arrays: the steps of the simulated rig, block by block and together."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from pamctl.plant import drive
from pamctl.plant.drive import Restarts, drive_coupled, drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters, settings_of, values_of
from pamctl.plant.paper import mechanics_step, middle_pressure_pa
from pamctl.plant.parameters import parameters_of, vented_state
from pamctl.plant.simulated import SimulatedPlant
from pamctl.plant.step import plant_step, pressure_block_step

TICK_S = 1e-3
STEP_S = 0.5 * TICK_S
SQUARE = np.array([5.0 if i % 400 < 200 else -5.0 for i in range(800)])
SMALL = np.array([0.0 if i % 400 > 300 else 1.5 * math.sin(0.02 * i) for i in range(1200)])
PAPER = plant_parameters(PlantSettings())
VALVE_109 = parameters_of({"valve_spool.time_constant_s": 1.46e-3})

plants = pytest.mark.parametrize("p", [PAPER, VALVE_109], ids=["paper", "valve109"])
commands = pytest.mark.parametrize("command_v", [SQUARE, SMALL], ids=["square", "small"])


@plants
@commands
def test_the_coupled_drive_is_the_simulated_rig_sampled_before_each_command(
    p, command_v: NDArray[np.float64]
) -> None:
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
def test_the_two_blocks_alone_compose_to_the_coupled_step_to_the_bit(
    p, command_v: NDArray[np.float64]
) -> None:
    state = vented_state(p)
    for command in command_v.tolist():
        x, v, pressure_pa, valve, air = state[:5]
        middle_m = x + 0.5 * STEP_S * v
        after = plant_step(p, state, command, STEP_S)
        alone = pressure_block_step(
            p, pressure_pa, valve, air, command, x, middle_m, after.position_m, state.age_s, STEP_S
        )
        assert alone == (after.pressure_pa, after.valve, after.air)
        if not p.valve_acts:
            middle_pa = middle_pressure_pa(p.paper, pressure_pa, command, x, middle_m, STEP_S)
            assert mechanics_step(p.paper, x, v, middle_pa, STEP_S) == after[:2]
        state = after


@plants
@commands
def test_each_block_driven_by_the_others_signal_follows_the_coupled_plant(
    p, command_v: NDArray[np.float64]
) -> None:
    """Between samples the other's signal is linear: an error of second order in the tick."""
    coupled = drive_coupled(p, command_v, TICK_S, steps=8)
    pressure = drive_pressure(p, command_v, coupled.position_m, TICK_S, steps=8)
    mechanics = drive_mechanics(p, coupled.pressure_pa, TICK_S, steps=8)
    assert np.abs(pressure.pressure_pa - coupled.pressure_pa).max() < 60.0
    assert np.abs(mechanics.position_m - coupled.position_m).max() < 4e-6
    finer = drive_coupled(p, command_v.repeat(4), TICK_S / 4)
    alone = drive_pressure(p, command_v.repeat(4), finer.position_m, TICK_S / 4)
    assert np.abs(alone.pressure_pa - finer.pressure_pa).max() < 10.0


@plants
def test_the_compiled_drives_are_their_plain_twins_to_the_bit(
    p, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_a_missed_tick_is_one_long_interval_under_one_command() -> None:
    twice = np.repeat(SQUARE, 2)
    every_tick = drive_coupled(PAPER, twice, TICK_S)
    dt_s = np.full(len(SQUARE) - 1, 2 * TICK_S)
    every_other = drive_coupled(PAPER, SQUARE, dt_s, steps=4)
    np.testing.assert_allclose(
        every_other.position_m, every_tick.position_m[::2], rtol=0, atol=1e-12
    )


def test_jitter_adds_no_step_and_an_interval_twice_as_long_has_twice_as_many() -> None:
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


def test_a_drive_can_start_in_the_middle_of_another() -> None:
    whole = drive_coupled(VALVE_109, SQUARE, TICK_S)
    plant = SimulatedPlant(VALVE_109)
    for command in SQUARE[:250].tolist():
        plant.advance(command, TICK_S)
    rest = drive_coupled(VALVE_109, SQUARE[250:], TICK_S, start=plant.state)
    np.testing.assert_array_equal(rest.position_m, whole.position_m[250:])


@pytest.mark.parametrize(
    ("command_v", "dt_s", "complaint"),
    [
        ([[1.0]], 1e-3, "shape"),
        ([1.0, math.nan], 1e-3, "sample 1"),
        ([1.0, 2.0], [1e-3, 1e-3, 1e-3], "one for each interval"),
        ([1.0, 2.0], [0.0], "longer than 0"),
    ],
)
def test_invalid_arrays_are_refused(command_v, dt_s, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        drive_coupled(PAPER, command_v, dt_s)
    with pytest.raises(ValueError, match="where the command has 3"):
        drive_pressure(PAPER, [0.0] * 3, [0.0] * 2, 1e-3)


def test_a_restart_undoes_the_scale_of_the_encoder_in_position_and_velocity() -> None:
    p = parameters_of(
        {"actuator": 1.0, "mass_kg": 95.0, "stiffness_n_per_m": 0.0, "encoder_scale.scale": 1.1}
    )
    again = Restarts(np.array([5]), np.array([0.22]), np.array([0.55]))
    moved = drive_mechanics(p, np.full(10, 101.3e3), TICK_S, restarts=again)
    assert moved.position_m[5] == pytest.approx(0.22)
    assert moved.true_position_m[5] == pytest.approx(0.2)
    assert moved.velocity_m_per_s[5] == pytest.approx(0.5)


def test_the_volume_behind_a_play_of_the_encoder_is_that_of_the_muscle() -> None:
    """Undone but for the way through the play, which the encoder does not show."""
    p = parameters_of({"encoder_backlash.width_m": 2e-4})
    moved = drive_coupled(p, SMALL, TICK_S)
    shown = (SMALL, moved.position_m, TICK_S)
    taken_as_it_is = drive_pressure(PAPER, *shown).pressure_pa - moved.true_pressure_pa
    undone = drive_pressure(p, *shown).pressure_pa - moved.true_pressure_pa
    assert np.std(taken_as_it_is) > 100.0
    assert np.std(undone) < 0.5 * np.std(taken_as_it_is)


# --- a plant as a flat mapping -----------------------------------------------------------------


def test_an_empty_mapping_is_the_papers_plant() -> None:
    assert parameters_of({}) == plant_parameters(PlantSettings()) == PAPER
    assert parameters_of(values_of(PlantSettings())) == PAPER


def test_a_flat_mapping_and_a_plant_file_are_equivalent() -> None:
    values = {"stiffness_n_per_m": 9500.0, "valve_spool.time_constant_s": 1e-3}
    settings = settings_of(values)
    assert settings.parameters.stiffness_n_per_m == 9500.0
    assert plant_parameters(settings) == parameters_of(values)
    assert values_of(settings).items() >= values.items()
    neutral = settings_of({"valve_spool.time_constant_s": 0.0, "valve_spool.damping_ratio": 0.5})
    assert neutral == PlantSettings()


def test_an_unknown_name_is_refused_with_the_nearest() -> None:
    with pytest.raises(KeyError, match=r"did you mean valve_spool\.time_constant_s"):
        parameters_of({"valve_spool.time_constant": 1e-3})
