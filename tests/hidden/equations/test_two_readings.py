"""The truth and `pamctl.plant` are two readings of one paper, written apart: they must agree.

So must the effects, where both have the same form of them: each catalogue entry is run beside an
implementation that knows nothing of it, with another integrator. The only file here that knows the
plant's kernels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hidden.equations.truth import Truth
from hidden.excitations import Excitation, fill_and_hold, multisine, square
from hidden.rig import HiddenRig, Passage
from hidden.sensors import Sensors
from pamctl.plant.drive import CoupledResponse, drive_coupled
from pamctl.plant.parameters import parameters_of

Numbers = Mapping[str, float]

PERFECT = Sensors(perfect=True, encoder_homed=False)
EXCITATIONS = [square(1.0, 2.0), multisine(1.2, 0.3, 60.0, 2.0, 5), fill_and_hold(2, 0.5, 5)]


def both(excitation: Excitation, plant: Numbers, truth: Numbers, sensors: Numbers) -> tuple[
    Passage, CoupledResponse
]:  # fmt: skip
    rig = HiddenRig(Truth(**truth), replace(PERFECT, **sensors), seed=0)
    passage = rig.run(excitation)
    assert passage.record.valve_v is not None
    return passage, drive_coupled(parameters_of(plant), passage.record.valve_v, 1e-3, steps=8)


def apart(passage: Passage, driven: CoupledResponse) -> tuple[float, float]:
    """Return the RMS difference of what the sensors show, m and Pa."""
    record = passage.record
    assert record.position_m is not None
    assert record.pressure_pa is not None
    assert np.ptp(record.position_m) > 4e-3, "both must really move"
    return tuple(  # type: ignore[return-value]
        float(np.sqrt(np.mean(np.square(a - b)[500:])))  # both must first have come to rest
        for a, b in (
            (record.position_m, driven.position_m),
            (record.pressure_pa, driven.pressure_pa),
        )
    )


@pytest.mark.parametrize("excitation", EXCITATIONS, ids=lambda e: e.name)
def test_both_readings_move_the_papers_muscle_alike(excitation: Excitation) -> None:
    passage, driven = both(excitation, {}, {}, {})
    assert np.abs(passage.true_position_m - driven.true_position_m).max() < 2e-6
    assert np.abs(passage.true_pressure_pa - driven.true_pressure_pa).max() < 50.0


ALIKE: dict[str, tuple[Numbers, Numbers, Numbers]] = {
    "valve_deadband": (
        {"fill_width_v": 0.2, "exhaust_width_v": 0.1},
        {"overlap_fill_v": 0.2, "overlap_vent_v": 0.1}, {}),
    "valve_asymmetry": ({"exhaust_gain": 0.8}, {"vent_gain": 0.8}, {}),
    "valve_saturation": ({"shortfall_v": 1.0}, {"drive_limit_v": 4.0}, {}),
    "valve_curve": ({"curvature_per_v": 0.03}, {"curve_per_v": 0.03}, {}),
    "valve_spool": (
        {"time_constant_s": 1.5e-3, "damping_ratio": 0.6},
        {"spool_rad_per_s": 1.0 / 1.5e-3, "spool_damping": 0.6}, {}),
    "valve_hysteresis": ({"width_v": 0.1}, {"play_v": 0.1}, {}),
    "valve_leak": ({"area_m2": 2e-8}, {"null_leak_m2": 2e-8}, {}),
    "command_delay": ({"delay_s": 1.7e-3}, {"delay_s": 1.7e-3}, {}),
    "chamber_leak": ({"area_m2": 1e-8}, {"chamber_leak_m2": 1e-8}, {}),
    "supply_droop": (
        {"resistance_pa_s_per_kg": 5e6, "refill_time_s": 0.05},
        {"regulator_pa_s_per_kg": 5e6, "tank_m3": 0.05 * 287.1 * 273.0 / 5e6}, {}),
    "line_restriction": (
        {"resistance_pa_s_per_kg": 3e6, "volume_m3": 4e-6},
        {"line_pa_s_per_kg": 3e6, "line_m3": 4e-6}, {}),
    "dead_volume": ({"volume_m3": 5e-6}, {"dead_m3": 5e-6}, {}),
    "polytropic": ({"exponent": 1.2}, {"polytropic": 1.2}, {}),
    "return_friction": ({"share": 0.2}, {"return_share": 0.2}, {}),
    "coulomb_friction": ({"force_n": 2.0}, {"coulomb_n": 2.0}, {}),
    "pressure_damping": ({"per_pa": 3e-4}, {"pressure_damping": 3e-4}, {}),
    "cubic_stiffness": ({"n_per_m3": 1e6}, {"cubic": 1e6}, {}),
    "creep": (
        {"stiffness_n_per_m": 400.0, "time_constant_s": 0.8},
        {"creep_n_per_m": 400.0, "creep_s": 0.8}, {}),
    "bladder_threshold": ({"pressure_pa": 5e3}, {"threshold_pa": 5e3}, {}),
    "braid_stretch": ({"compliance_per_pa": 5e-8}, {"stretch_per_pa": 5e-8}, {}),
    "end_cap": ({"length_m": 4e-3}, {"cap_m": 4e-3}, {}),
    "external_load": ({"force_n": 3.0}, {"load_n": 3.0}, {}),
    "moving_mass": ({"added_kg": 0.3}, {"mass_kg": 0.35}, {}),
    "stribeck": (
        {"rise": 0.1, "speed_m_per_s": 6e-3},
        {"stribeck": 0.1, "stribeck_m_per_s": 6e-3}, {}),
    "pressure_sensor_lag": ({"time_constant_s": 2e-3}, {"sensor_lag_s": 2e-3}, {}),
    "pressure_sensor_offset": ({"offset_pa": 3e3}, {}, {"pressure_offset_pa": 3e3}),
    "pressure_sensor_gain": ({"gain": 1.03}, {}, {"pressure_gain": 1.03}),
    "encoder_scale": ({"scale": 1.02}, {}, {"encoder_scale": 1.02}),
    "encoder_backlash": ({"width_m": 80e-6}, {"backlash_m": 80e-6}, {}),
}  # fmt: skip
"""Catalogue name -> the same numbers for the plant, for the truth and for its sensors."""


@cache
def without_effects() -> tuple[Passage, CoupledResponse]:
    return both(EXCITATIONS[1], {}, {}, {})


@pytest.mark.parametrize("name", sorted(ALIKE))
def test_both_readings_give_an_effect_the_same_result(name: str) -> None:
    plant, truth, sensors = ALIKE[name]
    flat = {f"{name}.{key}": value for key, value in plant.items()}
    passage, driven = both(EXCITATIONS[1], flat, truth, sensors)
    bare, _ = without_effects()
    position_m, pressure_pa = apart(passage, driven)
    effect_m, effect_pa = apart(bare, driven)
    size = math.hypot(effect_m / 3e-6, effect_pa / 300.0)
    assert math.hypot(position_m / 3e-6, pressure_pa / 300.0) < max(0.4, 0.01 * size)
