"""The noise of a channel: from what moves, from what rests, as stated, or unknown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pamctl.diagnose.fitting.floor import doubt_floor
from pamctl.diagnose.fitting.repeatability import find_repeats
from scipy.signal import butter, filtfilt, lfilter
from support.made_records import all_but, measured

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.measured.from_log import record_of
from pamctl.diagnose.measured.noise.filtering import find_filtering
from pamctl.diagnose.measured.noise.moving_noise import measure_growth
from pamctl.diagnose.measured.noise.sensor_noise import Noise, estimate_channel_noise
from pamctl.diagnose.measured.noise.stated_noise import parse_noise
from pamctl.diagnose.measured.noise.wander import measure_walk, remove_walk
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
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


def test_noise_that_grows_with_speed_is_told_from_noise_at_rest() -> None:
    record = measured("fit", 4)
    change = np.gradient(record["pressure_pa"])
    louder = record["pressure_pa"] + 0.3 * change * np.random.default_rng(2).normal(
        size=len(record)
    )
    grown = Record("grown", record.t_s, record["valve_v"], louder)
    assert measure_growth([record], "pressure_pa", 300.0, 47.5) == 0.0
    assert measure_growth([grown], "pressure_pa", 300.0, 47.5) == pytest.approx(0.3, rel=0.3)


def test_noise_that_grows_is_drawn_where_the_signal_moves() -> None:
    still, fast = np.zeros(5000), np.arange(5000) * 100.0
    noise = estimate_channel_noise([measured("fit", 4)], "pressure_pa")
    loud = noise.__class__(300.0, (), 0.0, 0.0, growth=10.0)
    random = np.random.default_rng(0)
    shown = loud.simulate_sensor(np.concatenate([still, fast]), random)
    assert np.std(shown[:4900]) == pytest.approx(300.0, rel=0.05)
    assert np.std(shown[5100:] - fast[100:]) == pytest.approx(np.hypot(300.0, 1000.0), rel=0.05)


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


def test_a_force_that_comes_again_is_a_repeat_although_it_is_noisy() -> None:
    t_s = np.arange(12_000) * 1e-3
    force_n = 20.0 * (np.sin(np.pi * t_s) > 0.0) + np.random.default_rng(0).normal(
        0.0, 0.05, len(t_s)
    )
    (repeat,) = find_repeats([Record("pulled", t_s, force_n=force_n)])
    assert repeat.demand == "force_n"
    assert (repeat.again - repeat.start) % 2000 == 0
    assert repeat.length >= 5000


def test_the_document_says_where_noise_comes_from_and_a_stated_one_counts() -> None:
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
    assert found.model is not None
    assert found.model.rms["pressure"] == pytest.approx(300.0 / 900.0, rel=0.1)


def test_where_noise_is_unknown_the_floor_is_an_estimate_from_quiet_stretches() -> None:
    def smoothed(program: str, seed: int) -> Record:
        # Filtered from the first sample on, without a rest: nothing shows the noise.
        record = measured(program, seed)
        awake = record.cut_samples(650, len(record), program)
        pressure_pa = filtfilt(*butter(2, 0.3), awake["pressure_pa"])
        return Record(program, awake.t_s, awake["valve_v"], pressure_pa, awake["position_m"])

    found = diagnose(
        [smoothed("fit", 1)],
        [smoothed("judge", 2)],
        PlantSettings(),
        without=all_but("valve_leak"),
    )
    document = build_diagnosis_document(found)
    assert document["noise"]["pressure_pa"]["source"] == "unknown"
    assert document["noise"]["pressure_pa"]["deviation"] is None
    assert "noise unknown" in document["noise"]["pressure_pa"]["says"][0]
    limit = document["limits"]["pressure"]
    assert limit["is_estimate"]
    assert limit["decided_by"] == "quiet stretches"


def test_a_residual_of_a_million_floors_is_a_wrong_floor() -> None:
    assert doubt_floor("pressure", 400.0) == ""
    assert "the floor is wrong" in doubt_floor("mechanics", 5e5)


@pytest.mark.parametrize(("walk_pa", "found"), [(0.0, False), (40.0, True)])
def test_a_zero_that_wanders_at_rest_is_noise_with_a_long_memory(
    walk_pa: float, found: bool
) -> None:
    random = np.random.default_rng(3)
    rests = [
        random.normal(0.0, 300.0, 900)
        + np.cumsum(random.normal(0.0, walk_pa, 900))
        + 500.0 * np.exp(-np.arange(900) / 300.0)  # the end of a venting is no walk
        for _ in range(4)
    ]
    walk = measure_walk(rests)
    assert (walk > 0.0) is found
    if found:
        assert walk == pytest.approx(walk_pa, rel=0.3)
        assert np.std(remove_walk(rests[0])) == pytest.approx(300.0, rel=0.1)
        noise = Noise(300.0, (), 0.0, 0.0, walk=walk)
        spread = np.std([noise.draw(4000, random)[-1] for _ in range(200)])
        assert spread == pytest.approx(np.hypot(300.0, walk * np.sqrt(4000.0)), rel=0.15)


def test_noise_with_a_memory_of_milliseconds_is_no_walk() -> None:
    """Found where none is, a walk raises the floor tenfold and hides what is missing."""
    random = np.random.default_rng(6)
    keep = np.exp(-1.0 / 4.0)
    found = 0
    for _ in range(500):
        kicks = random.normal(0.0, 300.0 * np.sqrt(0.3 * (1.0 - keep**2)), (8, 1000))
        slow = lfilter([1.0], [1.0, -keep], kicks)[:, 200:]
        fast = random.normal(0.0, 300.0 * np.sqrt(0.7), (8, 800))
        found += measure_walk([*(fast + slow)]) > 0.0
    assert found <= 1


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


def test_a_stated_noise_is_all_the_noise_there_is() -> None:
    random = np.random.default_rng(3)
    moving_pa = np.concatenate([np.zeros(900), 1e5 * np.sin(0.003 * np.arange(2000)) ** 2])
    records = [
        Record(
            f"wandering-{k}",
            1e-3 * np.arange(2900),
            valve_v=np.repeat([-5.0, 5.0], [900, 2000]),
            pressure_pa=2e5
            + moving_pa
            + random.normal(0.0, 300.0, 2900)
            + np.cumsum(random.normal(0.0, 40.0, 2900)),
        )
        for k in range(4)
    ]
    assert estimate_channel_noise(records, "pressure_pa").walk > 0.0
    stated = [replace(r, stated_noise={"pressure_pa": 250.0}) for r in records]
    noise = estimate_channel_noise(stated, "pressure_pa")
    assert (noise.source, noise.deviation, noise.walk) == ("stated", 250.0, 0.0)
