"""Missed ticks: filters count seconds, and the pressure between two samples is no straight line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pamctl.diagnose.fitting.drives import prepare_mechanics_drive, prepare_pressure_drive

from pamctl.diagnose.measured.from_log import record_of
from pamctl.diagnose.measured.missed_ticks import find_long_intervals, smooth_over_missed
from pamctl.diagnose.measured.noise.sensor_noise import estimate_channel_noise
from pamctl.diagnose.measured.record import Record
from pamctl.plant.drive import drive_coupled
from pamctl.plant.flat import parameters_of
from pamctl.plant.model import PlantSettings

GOLDEN = Path(__file__).parents[2] / "golden"
PAPER = PlantSettings()


def missed_record(late_s: float = 0.0) -> Record:
    """Return the paper's rig on a busy PC, without noise: a third of the ticks are missed."""
    random = np.random.default_rng(3)
    command_v = np.where(np.arange(6000) % 400 < 200, 5.0, -5.0)
    command_v[:500] = -5.0
    kept = np.concatenate([np.arange(500), 500 + np.cumsum(random.choice([1, 1, 1, 15], 2500))])
    kept = kept[kept < len(command_v)]
    held_v = command_v[kept]
    dt_s = np.diff(kept) * 1e-3
    every = np.repeat(held_v[:-1], np.diff(kept))
    driven = drive_coupled(parameters_of({}), every, 1e-3, steps=8, acts_after_s=late_s)
    at = kept[:-1]
    return Record(
        "busy",
        np.concatenate([[0.0], np.cumsum(dt_s)])[:-1],
        valve_v=held_v[:-1],
        pressure_pa=driven.pressure_pa[at],
        position_m=driven.position_m[at],
        acts_after_s=np.full(len(at), late_s) if late_s else None,
    )


def test_a_record_without_missed_ticks_is_smoothed_as_it_is() -> None:
    steps_s = np.full(99, 1e-3) + np.random.default_rng(1).uniform(-1e-4, 1e-4, 99)
    values = np.arange(100.0)
    seen = []

    def smooth(even: NDArray[np.float64]) -> NDArray[np.float64]:
        seen.append(even)
        return even

    assert smooth_over_missed(values, steps_s, smooth) is values
    assert seen[0] is values
    assert not find_long_intervals(steps_s).any()


def test_a_filter_leaves_a_straight_motion_straight_over_missed_ticks() -> None:
    steps = np.random.default_rng(2).choice([1, 1, 2, 6], 400)
    t_s = np.concatenate([[0.0], np.cumsum(steps)]) * 1e-3
    inside = slice(20, -20)

    def average(even: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.convolve(even, np.ones(9) / 9.0, "same")

    smooth = smooth_over_missed(t_s, np.diff(t_s), average)
    np.testing.assert_allclose(smooth[inside], t_s[inside], rtol=0, atol=1e-12)
    assert np.abs(average(t_s) - t_s)[inside].max() > 1e-3


@pytest.mark.parametrize("late_s", [0.0, 2e-4])
def test_both_blocks_of_a_busy_pc_s_record_follow_the_very_plant(late_s: float) -> None:
    record = missed_record(late_s)
    noises = {c: estimate_channel_noise([record], c) for c in ("pressure_pa", "position_m")}
    pressure = prepare_pressure_drive(record, noises, PAPER)
    off_pa = pressure.simulate(PAPER) - record["pressure_pa"]
    assert np.sqrt(np.mean(off_pa**2)) < 300.0
    modelled_pa = pressure.simulate(PAPER)
    mechanics = prepare_mechanics_drive(record, noises, modelled_pa, 1.0)
    straight_m = mechanics.simulate(PAPER) - record["position_m"]
    bent = replace(mechanics, bend=pressure.find_bend(PAPER))
    off_m = bent.simulate(PAPER) - record["position_m"]
    assert np.sqrt(np.mean(straight_m**2)) > 4.0 * np.sqrt(np.mean(off_m**2))
    assert np.sqrt(np.mean(off_m**2)) < 6e-6


def test_a_record_without_missed_ticks_bends_no_pressure() -> None:
    record = missed_record().cut_samples(0, 400, "quiet")
    noises = {"pressure_pa": estimate_channel_noise([record], "pressure_pa")}
    assert prepare_pressure_drive(record, noises, PAPER).find_bend(PAPER) is None


def test_the_record_of_a_real_time_log_knows_when_commands_act_and_its_cuts_do() -> None:
    record = record_of(GOLDEN / "missed.mcap")
    assert record.acts_after_s is not None
    assert record.acts_after_s.min() > 1e-5
    assert record.acts_after_s.max() > 5e-3  # a slow read
    cut = record.cut_samples(10, 60, "part")
    np.testing.assert_array_equal(cut.acts_after_s, record.acts_after_s[10:60])
    assert cut.held_v == record["valve_v"][9]
    assert record.held_v == -5.0  # the end of homing
    assert record_of(GOLDEN / "qsmc.mcap").acts_after_s is None
    with pytest.raises(ValueError, match="acts_after_s has 3 samples"):
        Record("wrong", np.arange(4.0), valve_v=np.zeros(4), acts_after_s=np.zeros(3))
