"""The noise of a channel: as stated, or read from the data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.made_records import ask_only, measured

from pamctl.diagnose import diagnose
from pamctl.diagnose.record import estimate_white_noise, parse_noise, pool_stated_noise, record_of
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.log.importing.column_map import ImportMap
from pamctl.log.importing.pipeline import import_log
from pamctl.log.record_problems import find_sensor_step
from pamctl.plant.model import NoiseSettings, PlantSettings
from pamctl.watch.judge_window import SensorNoise


@pytest.mark.parametrize("rate_hz", [1000.0, 100.0])
@pytest.mark.parametrize("step_m", [0.0, 2.3e-4])
def test_white_noise_is_read_from_a_signal_that_never_rests(rate_hz: float, step_m: float) -> None:
    t_s = np.arange(8.0 * rate_hz) / rate_hz
    motion_m = 0.01 * np.sin(2.0 * t_s) + 0.004 * np.sin(9.0 * t_s + 1.0)
    position_m = motion_m + np.random.default_rng(0).normal(0.0, 1e-4, len(t_s))
    if step_m:
        position_m = np.round(position_m / step_m) * step_m
    total_m = np.hypot(1e-4, step_m / np.sqrt(12.0))
    assert estimate_white_noise(position_m) == pytest.approx(total_m, rel=0.08)


def test_the_step_of_a_converter_is_found_at_one_speed() -> None:
    ramp = np.abs((np.arange(5000) * 7.13e-5) % 0.06 - 0.03)
    assert find_sensor_step(np.round(ramp / 3e-6) * 3e-6) == pytest.approx(3e-6)


def test_stated_noise_comes_from_the_option_the_plant_file_or_the_import_map(
    tmp_path: Path,
) -> None:
    assert parse_noise(["position_m=2e-6", "force_n=0"]) == {"position_m": 2e-6, "force_n": 0.0}
    for wrong, says in (
        ("speed=1", "position_m=... (m)"),
        ("valve_v=1", "states no channel"),
        ("force_n=-1", "a number of N"),
        ("force_n=nan", "0 or more"),
        ("force_n=many", "'many'"),
    ):
        with pytest.raises(ValueError, match=says.replace("(", r"\(").replace(")", r"\)")):
            parse_noise([wrong])
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        NoiseSettings(position_m=-1.0)
    table = "\n".join(f"{k * 0.01:.2f},{np.sin(k):.4f},{k % 7}" for k in range(300))
    (tmp_path / "a.csv").write_text("t,x,F\n" + table)
    mapped = ImportMap.model_validate(
        {
            "time": {"column": "t"},
            "position": {"column": "x", "unit": "mm", "noise": 0.004},
            "force": {"column": "F"},
        }
    )
    assert import_log(tmp_path / "a.csv", tmp_path / "a.mcap", mapped).written
    record = record_of(tmp_path / "a.mcap")
    assert record.stated_noise == {"position_m": 4e-6}
    assert pool_stated_noise([record])["position_m"] == pytest.approx(4e-6, rel=1e-3)


@pytest.mark.parametrize("by", ["the option", "the record"])
def test_the_document_says_where_noise_comes_from(by: str) -> None:
    stated = {"pressure_pa": 900.0}
    own = stated if by == "the record" else {}
    found = diagnose(
        [replace(measured("fit", 1), stated_noise=own)],
        [replace(measured("judge", 2), stated_noise=own)],
        PlantSettings(noise=NoiseSettings(position_m=3e-6)),
        without=ask_only("valve_leak"),
        noise=None if own else stated,
    )
    noise = build_diagnosis_document(found)["noise"]
    assert (noise["pressure_pa"]["source"], noise["position_m"]["source"]) == ("stated", "stated")
    assert noise["pressure_pa"]["deviation"] == pytest.approx(900.0)
    assert noise["pressure_pa"]["faults"] == []
    assert found.plant.noise == NoiseSettings(position_m=3e-6)


def test_the_rounding_of_a_slow_signal_is_slow() -> None:
    """A coarse converter shows a still signal off by one amount, not by noise."""
    coarse = SensorNoise(0.0, 100.0)
    random = np.random.default_rng(5)
    still = np.full(50, 123.0)
    errors = np.array([coarse.simulate_sensor(still, random) - still for _ in range(400)])
    assert np.all(np.ptp(errors, axis=1) == 0.0)
    assert np.std(errors[:, 0]) == pytest.approx(100.0 / np.sqrt(12.0), rel=0.1)
