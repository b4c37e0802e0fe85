"""A hidden rig gives what a user would have measured, and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hidden.excitations import square, tracking
from hidden.own_run import HiddenPlant
from hidden.rig import hidden_rig
from hidden.sensors import ADC_STEP_PA, AO_STEP_V, ENCODER_STEP_M


def test_a_rig_is_read_in_counts_and_adc_steps_at_times_that_jitter() -> None:
    record = hidden_rig({}, seed=2).run(square(1.0, 1.0)).record
    assert record.position_m is not None
    assert record.pressure_pa is not None
    counts = record.position_m / ENCODER_STEP_M
    codes = record.pressure_pa / ADC_STEP_PA
    assert np.allclose(counts, np.round(counts), atol=1e-6)
    assert np.allclose(codes, np.round(codes), atol=1e-6)
    steps = np.diff(record.t_s)
    assert steps.min() > 0.4e-3
    assert steps.max() < 1.6e-3
    assert 2e-6 < steps.std() < 60e-6


def test_in_a_closed_loop_the_command_carries_the_noise() -> None:
    rig = hidden_rig({}, seed=4)
    excitation = tracking(4.0, seed=1)
    quiet = replace(rig, sensors=replace(rig.sensors, pressure_noise_pa=1.0))
    record, calm = rig.run(excitation).record, quiet.run(excitation).record
    assert record.valve_v is not None
    assert calm.valve_v is not None
    assert record.position_m is not None
    assert excitation.wanted_m is not None
    assert np.abs(record.valve_v - calm.valve_v).max() > 1e-3
    settled = np.abs(record.position_m - excitation.wanted_m)
    assert np.median(settled[1500:]) < 1e-3, "the loop tracks"


def test_an_overrun_leaves_a_gap_in_the_record() -> None:
    rig = hidden_rig({}, seed=3)
    record = replace(rig, sensors=replace(rig.sensors, missed_ticks=3)).run(square(1.0, 2.0)).record
    steps = np.diff(record.t_s)
    assert 1 <= np.sum(steps > 1.7e-3) <= 3


def test_a_loop_that_drives_the_rig_sees_what_a_record_shows() -> None:
    rig = hidden_rig({"command_delay": 10, "creep": 10, "pressure_sensor_gain": 10}, seed=6)
    rig = replace(rig, sensors=replace(rig.sensors, perfect=True))
    excitation = replace(square(1.0, 1.0), rest_v=0.0)
    assert excitation.volts is not None
    volts = np.where(excitation.volts == -1.0, 0.0, excitation.volts)
    record = rig.run(replace(excitation, volts=volts)).record
    plant = HiddenPlant(rig)
    assert record.position_m is not None
    assert record.pressure_pa is not None
    for k, command in enumerate(volts):
        assert abs(plant.position_m - record.position_m[k]) < 1e-8
        assert abs(plant.pressure_pa - record.pressure_pa[k]) < 0.1
        plant.advance(float(np.round(command / AO_STEP_V) * AO_STEP_V), 1e-3)
