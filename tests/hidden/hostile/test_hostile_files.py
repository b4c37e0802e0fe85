"""Each fault of a laboratory does what it says: against closed forms, or another rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from hidden.effects import Size
from hidden.equations.truth import Truth
from hidden.excitations import Excitation
from hidden.hostile.file_of_lab import record_of, truth_over_time
from hidden.hostile.lab import Lab
from hidden.hostile.programs import random_levels
from hidden.hostile.situations import HostileCase, all_cases
from hidden.rig import HiddenRig, hidden_rig
from hidden.sensors import Sensors

Array = NDArray[np.float64]

PERFECT = Sensors(perfect=True)
PAPER = Truth()
STEP_S = 50e-6
WHOLE = random_levels(3)[0][0]
assert WHOLE.volts is not None
SHORT = Excitation("short", WHOLE.volts[:3000], seed=3)
STILL = Excitation("still", np.full(12_000, -1.0), seed=5)


def columns(
    lab: Lab | None = None,
    truth: Truth = PAPER,
    *,
    sensors: Sensors = PERFECT,
    excitation: Excitation = SHORT,
    order: float = 0.0,
) -> dict[str, Array]:
    rig = HiddenRig(truth, sensors, seed=9, step_s=STEP_S)
    return record_of(rig, lab or Lab(), excitation, order).columns()


@cache
def plain() -> dict[str, Array]:
    return columns()


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def assert_alike(a: Mapping[str, Array], b: Mapping[str, Array], rows: slice) -> None:
    """Both have the same pressure and position: within 1 Pa and 10 nm."""
    assert np.abs(a["pressure_pa"] - b["pressure_pa"])[rows].max() < 1.0
    assert np.abs(a["position_m"] - b["position_m"])[rows].max() < 1e-8


# --- the pass itself -------------------------------------------------------------------------


def test_without_a_fault_the_file_is_that_of_the_hidden_rig() -> None:
    theirs = HiddenRig(PAPER, PERFECT, seed=9, step_s=STEP_S).run(SHORT).record.columns()
    assert_alike(plain(), theirs, slice(None))
    assert np.array_equal(plain()["valve_v"], theirs["valve_v"])
    assert np.ptp(theirs["position_m"]) > 5e-3


# --- the rig ---------------------------------------------------------------------------------


@pytest.mark.parametrize("volts", [0.15, -0.2])
def test_a_null_offset_is_a_command_that_is_off_by_it(volts: float) -> None:
    lab = Lab(truth={"overlap_fill_v": volts, "overlap_vent_v": -volts})
    assert SHORT.volts is not None
    step = 20.0 / 65536.0
    exact = round(volts / step) * step
    off = columns(replace(lab, truth={"overlap_fill_v": exact, "overlap_vent_v": -exact}))
    moved = replace(SHORT, volts=np.round(SHORT.volts / step) * step - exact, rest_v=-1.0 - exact)
    assert_alike(off, columns(excitation=moved), slice(None))


def test_numbers_change_within_and_between_records_and_at_an_instant() -> None:
    lab = Lab(within={"stiffness": -0.04}, between={"mu_k": -0.15})
    last = truth_over_time(PAPER, lab, 1.0, 10.0)
    assert last(0.0).stiffness == PAPER.stiffness
    assert last(5.0).stiffness == pytest.approx(0.98 * PAPER.stiffness)
    assert last(10.0).stiffness == pytest.approx(0.96 * PAPER.stiffness)
    assert last(0.0).mu_k == pytest.approx(0.85 * PAPER.mu_k)
    assert truth_over_time(PAPER, lab, 0.0, 10.0)(3.0).mu_k == PAPER.mu_k
    leaking = truth_over_time(PAPER, Lab(at_half={"chamber_leak_m2": 1e-8}), 0.0, 10.0)
    assert leaking(4.999).chamber_leak_m2 == 0.0
    assert leaking(5.0).chamber_leak_m2 == 1e-8


# --- time ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("channel", "name"), [("pressure_pa", "late"), ("position_m", "early")])
def test_a_column_that_is_late_is_shifted_by_rows(channel: str, name: str) -> None:
    rows = 2 if name == "late" else -2
    skewed = columns(Lab(late_s={channel: rows * 1e-3}))  # type: ignore[dict-item]
    kept = slice(10, -10)
    assert np.allclose(skewed[channel][kept], np.roll(plain()[channel], rows)[kept], rtol=1e-9)
    others = {"valve_v", "pressure_pa", "position_m"} - {channel}
    for other in others:
        assert np.allclose(skewed[other], plain()[other], rtol=1e-7, atol=1e-12)


# --- columns ---------------------------------------------------------------------------------


def test_signs_scales_and_zeros_are_of_the_column() -> None:
    channels = ("valve_v", "pressure_pa", "position_m")
    made = columns(Lab(inverted=channels, pressure_zero_shift_pa=-101.3e3))
    assert np.array_equal(made["valve_v"], -plain()["valve_v"])
    gauge = plain()["pressure_pa"] - 101.3e3
    assert np.allclose(made["pressure_pa"], -gauge, rtol=1e-9, atol=1e-6)
    assert np.allclose(made["position_m"], -plain()["position_m"])
    scaled = columns(Lab(position_scale=4.0))["position_m"]
    assert np.allclose(scaled, 4.0 * plain()["position_m"])


# --- the cases -------------------------------------------------------------------------------


LOUD = {
    case.id.split("/")[0]: case  # the smallest size of each, which comes first
    for case in reversed([*all_cases()])
    if case.excitation == "random" and not case.answer.silent
}.values()


@pytest.mark.parametrize("case", LOUD, ids=lambda case: case.id)
def test_what_must_be_said_shows_in_the_file(case: HostileCase) -> None:
    """The fault moves a column, or the file is wrong by itself: by half of the noise at least."""
    if case.lab.plant_factors or case.lab.plant:
        pytest.skip("the plant file is wrong, not the record")
    run = WHOLE if case.lab.clock_rates else SHORT  # clocks need time to part
    seen = [_perfect(case.effects, case.lab, run), _perfect({}, Lab(), run)]
    floors = {"t_s": 50e-6, "valve_v": 5e-3, "pressure_pa": 300.0, "position_m": 5e-6}
    apart = [rms(seen[0][name] - seen[1][name]) / floor for name, floor in floors.items()]
    assert max(apart) > 0.5


def _perfect(effects: Mapping[str, Size], lab: Lab, run: Excitation) -> dict[str, Array]:
    rig = hidden_rig(effects, seed=7, miscalibrated=False)
    rig = replace(rig, sensors=replace(rig.sensors, perfect=True), step_s=STEP_S)
    return record_of(rig, lab, run, 1.0).columns()
