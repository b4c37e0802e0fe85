"""The noise of a channel: from what moves, from what rests, as stated, or unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, filtfilt, lfilter
from support.made_records import all_but, measured

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.record import record_of
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.sensor_noise import Noise, estimate_channel_noise, find_filtering, parse_noise
from pamctl.log.importing.column_map import ImportMap
from pamctl.log.importing.pipeline import import_log
from pamctl.log.record_problems import find_sensor_step
from pamctl.plant.model import NoiseSettings, PlantSettings

SIGMA_M = 1e-4


def moving(rate_hz: float, seed: int = 0, noise_m: float = SIGMA_M, **post: float) -> Record:
    """A sum of sines that never rests, with white noise."""
    random = np.random.default_rng(seed)
    t_s = np.arange(int(max(8.0 * rate_hz, 3000 if rate_hz > 50 else 600))) / rate_hz
    slow = min(1.0, rate_hz / 100.0)
    position_m = sum(
        0.01 / (k + 1) * np.sin(2 * np.pi * f * slow * t_s + k)
        for k, f in enumerate((0.31, 0.73, 1.13, 2.1))
    ) + random.normal(0.0, noise_m, len(t_s))
    if step := post.get("step_m"):
        position_m = np.round(position_m / step) * step
    return Record("moving", t_s, position_m=position_m)


@pytest.mark.parametrize(("rate_hz", "within"), [(1000.0, 0.04), (100.0, 0.05), (10.0, 0.1)])
@pytest.mark.parametrize("step_m", [0.0, 2.3e-4])
def test_white_noise_is_read_from_a_signal_that_never_rests(
    rate_hz: float, within: float, step_m: float
) -> None:
    noise = estimate_channel_noise([moving(rate_hz, step_m=step_m)], "position_m")
    assert noise.source == "spectrum"
    assert noise.total == pytest.approx(np.hypot(SIGMA_M, step_m / np.sqrt(12.0)), rel=within)


@pytest.mark.parametrize("rate_hz", [1000.0, 100.0])
def test_noise_is_unknown_where_the_data_are_filtered_or_lively_or_coloured(rate_hz: float) -> None:
    plain = moving(rate_hz)
    white = np.random.default_rng(1).normal(size=len(plain))
    smooth = filtfilt(*butter(2, 0.12), plain["position_m"])
    lively = 0.03 * lfilter([1.0], [1.0, -0.5], white)
    coloured = moving(rate_hz, noise_m=0.0)["position_m"] + 6e-5 * lfilter([1.0], [1, -0.8], white)
    for position_m in (smooth, np.round(smooth, 6), lively, coloured):
        record = Record("made", plain.t_s, position_m=position_m)
        assert not estimate_channel_noise([record], "position_m").is_known


def test_a_filter_is_found_by_its_edge_and_by_what_comes_before_its_cause() -> None:
    record = measured("fit", 4)
    assert find_filtering([record], "pressure_pa") is None
    pressure_pa = filtfilt(*butter(2, 0.06), record["pressure_pa"])
    smoothed = Record("smoothed", record.t_s, record["valve_v"], pressure_pa)
    found = find_filtering([smoothed], "pressure_pa")
    assert found is not None
    assert found.is_zero_phase


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
    noise = estimate_channel_noise([record], "position_m")
    assert (noise.source, noise.total) == ("stated", pytest.approx(4e-6))


def test_the_document_says_where_noise_comes_from() -> None:
    found = diagnose(
        [measured("fit", 1)],
        [measured("judge", 2)],
        PlantSettings(noise=NoiseSettings(position_m=3e-6)),
        without=all_but("valve_leak"),
        noise={"pressure_pa": 900.0},
    )
    noise = build_diagnosis_document(found)["noise"]
    assert (noise["pressure_pa"]["source"], noise["position_m"]["source"]) == ("stated", "stated")
    assert noise["pressure_pa"]["deviation"] == pytest.approx(900.0)
    assert noise["pressure_pa"]["faults"] == []
    assert found.plant.noise == NoiseSettings(position_m=3e-6)


def test_the_rounding_of_a_slow_signal_is_slow() -> None:
    """A coarse converter shows a still signal off by one amount, not by noise."""
    coarse = Noise(0.0, (), 0.0, 100.0)
    random = np.random.default_rng(5)
    still = np.full(50, 123.0)
    errors = np.array([coarse.simulate_sensor(still, random) - still for _ in range(400)])
    assert np.all(np.ptp(errors, axis=1) == 0.0)
    assert np.std(errors[:, 0]) == pytest.approx(100.0 / np.sqrt(12.0), rel=0.1)


@pytest.mark.parametrize("share", [0.3, 0.45])
@pytest.mark.parametrize("offset", [0.0, 0.2])
def test_noise_below_a_converters_step_is_read_from_how_often_each_step_is_shown(
    share: float, offset: float
) -> None:
    random = np.random.default_rng(8)
    t_s = np.arange(3000) * 1e-3
    true = 100.0 * (offset + np.where(t_s < 1.0, 0.0, 300.0 * np.sin(t_s - 1.0)))
    shown = 100.0 * np.round(true / 100.0 + random.normal(0.0, share, 3000))
    valve_v = np.where(t_s < 1.0, -1.0, 1.0)
    noise = estimate_channel_noise([Record("rest", t_s, valve_v, shown)], "pressure_pa")
    assert noise.resolution == pytest.approx(100.0)
    assert noise.deviation == pytest.approx(100.0 * share, rel=0.15)
