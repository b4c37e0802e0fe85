"""Windows of an axis: the state in which one begins is no missing effect."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.evidence.measured_motion import find_starts
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.plant.model import PlantSettings

T_S = np.arange(0.0, 8.0, 1e-3)


def move(mass_kg: float, damping_n_s_per_m: float, seed: int) -> Record:
    """Return a linear axis that quick and slow forces move; its encoder has steps of 1 um."""

    def force_n(t: float) -> float:
        return float(25.0 * np.sin(9.0 * t + seed) + 20.0 * np.sin(29.0 * t) + 9.0 * np.sin(41 * t))

    def rates(t: float, y: np.ndarray) -> list[float]:
        return [y[1], (force_n(t) - damping_n_s_per_m * y[1]) / mass_kg]

    found = solve_ivp(rates, (0.0, T_S[-1]), [0.0, 0.0], "DOP853", T_S, rtol=1e-9, atol=1e-12)
    rounded_m = 1e-6 * np.round(1e6 * found.y[0])
    return Record(f"run {seed}", T_S, position_m=rounded_m, force_n=np.array([*map(force_n, T_S)]))


def test_where_windows_begin_the_speed_of_a_quick_motion_is_not_late() -> None:
    position_m = 5e-3 * np.sin(60.0 * T_S)
    rounded_m = 1e-6 * np.round(1e6 * position_m)
    found = find_starts(rounded_m, 1e-3, T_S)
    inside = slice(100, -100)
    off = found["speed"] - 0.3 * np.cos(60.0 * T_S)
    assert np.sqrt(np.mean(off[inside] ** 2)) < 1e-3 * 0.3


def test_a_still_axis_is_smoothed_over_the_whole_width() -> None:
    chance = np.random.default_rng(4)
    position_m = chance.normal(0.0, 1e-5, len(T_S))
    found = find_starts(position_m, 1e-3, T_S)
    assert np.std(found["speed"][100:-100]) < 3e-3


@pytest.mark.long
def test_of_an_exact_axis_nothing_is_missing_and_its_numbers_lie_in_their_intervals() -> None:
    plant = PlantSettings.model_validate(
        {
            "actuator": "direct",
            "parameters": {"mass_kg": 5.0, "damping_n_s_per_m": 40.0, "stiffness_n_per_m": 0.0},
        }
    )
    found = diagnose([move(6.5, 45.0, 1)], [move(6.5, 45.0, 2)], plant)
    assert not [f.name for f in found.findings if f.says_name]
    assert found.evidence is not None
    assert found.evidence.gap["recalibrated"]["position_m"] < 1e-5
    numbers = build_diagnosis_document(found)["recalibrated"]
    # Between samples the model's force is a straight line: that costs less than a thousandth.
    for name, true in (("mass_kg", 6.5), ("damping_n_s_per_m", 45.0)):
        low, high = numbers[name]["ci90"]
        assert low - 1e-3 * true < true < high + 1e-3 * true, name
