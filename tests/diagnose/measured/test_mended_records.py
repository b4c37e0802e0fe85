"""What is taken off before a fit: faults of sensors and of homing; and the noise that is left."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, filtfilt
from support.made_records import ask_only, measured

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.evidence.weigh import prepare_weigher
from pamctl.diagnose.mend import (
    align_resting_pressure,
    find_outliers,
    find_regular_times,
    is_filtered,
    mend_records,
    remove_hum,
)
from pamctl.diagnose.read_record import record_of
from pamctl.diagnose.record import estimate_white_noise, parse_noise, pool_stated_noise
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.log.importing.column_map import ImportMap
from pamctl.log.importing.pipeline import import_log
from pamctl.log.row_problems import AROUND
from pamctl.plant.model import NoiseSettings, PlantSettings
from pamctl.watch.judge_window import SensorNoise


def test_a_sound_record_stays_as_it_is():
    record = measured("fit", 7)
    (mended,), faults = mend_records([record])
    assert faults == []
    assert mended.counts is None
    assert all(np.array_equal(mended[c], record[c]) for c in record.channels)


@pytest.mark.parametrize("channel", ["pressure_pa", "position_m"])
def test_spikes_and_dropouts_do_not_count(channel):
    record = measured("fit", 7)
    random = np.random.default_rng(0)
    rows = np.arange(800, len(record) - 100, 400)
    values = record[channel].copy()
    values[rows] += random.choice([-0.3, 0.3], len(rows)) * np.ptp(values)
    values[rows[0] + 100 : rows[0] + 104] = 0.0
    (mended,), faults = mend_records([replace(record, **{channel: values})])
    assert {f.kind for f in faults} == {"outliers", "dropouts"}
    assert mended.counts is not None
    lost = np.flatnonzero(~mended.counts)
    assert len({*rows} & {*lost}) >= len(rows) - 2
    assert len(lost) <= len(rows) + 6
    assert np.abs(mended[channel] - record[channel]).max() < 0.05 * np.ptp(record[channel])


def test_one_missing_cell_is_one_sample():
    record = measured("fit", 7)
    pressure_pa = record["pressure_pa"].copy()
    pressure_pa[700] = np.nan
    _, (fault,) = mend_records([replace(record, pressure_pa=pressure_pa)])
    assert "in 1 sample, the first at 0.7 s" in fault.says


def test_missing_cells_do_not_count_and_a_command_holds_over_them():
    record = measured("fit", 7)
    pressure_pa, valve_v = record["pressure_pa"].copy(), record["valve_v"].copy()
    pressure_pa[[700, 701, 1500]], valve_v[2500] = np.nan, np.nan
    valve_v[3000:3050] = np.nan
    (mended,), faults = mend_records([replace(record, pressure_pa=pressure_pa, valve_v=valve_v)])
    assert [f.channel for f in faults] == ["valve_v", "pressure_pa"]
    assert "3 samples, the first at 0.7 s" in faults[1].says
    assert mended.counts is not None
    assert [*np.flatnonzero(~mended.counts)] == [700, 701, 1500, 2500]
    assert mended["valve_v"][2500] == record["valve_v"][2499]
    assert np.array_equal(mended.t_s, np.delete(record.t_s, np.s_[3000:3050]))
    whole = np.delete(record["pressure_pa"], np.s_[3000:3050])
    assert np.abs(mended["pressure_pa"] - whole).max() < 0.01 * np.ptp(whole)
    found = diagnose([mended], [], PlantSettings(), without=ask_only("stribeck"))
    assert found.evidence is not None
    assert found.evidence.findings == ()
    assert found.evidence.gap["extended"]["position_m"] < 1e-6


def test_a_channel_that_is_mostly_missing_is_left_to_the_refusal():
    record = measured("fit", 7)
    gone = np.where(np.arange(len(record)) % 5 == 0, np.nan, record["pressure_pa"])
    (same,), faults = mend_records([replace(record, pressure_pa=gone)])
    assert faults == []
    assert np.isnan(same["pressure_pa"]).any()


def test_dropouts_close_together_and_beside_a_jump_of_the_command_do_not_count():
    record = measured("fit", 7)
    assert record.valve_v is not None
    jumps = np.flatnonzero(np.abs(np.diff(record.valve_v)) > 0.5 * np.ptp(record.valve_v)) + 1
    alone = np.random.default_rng(5).integers(AROUND, len(record) - 100, 12)
    pressure_pa = record["pressure_pa"].copy()
    filled = jumps[pressure_pa[jumps] > 0.5 * pressure_pa.max()]
    assert len(filled) > 1
    rows = [*filled + 2, *(start + k for start in alone for k in (0, 1, 2, 7, 8))]
    pressure_pa[rows] = 0.0
    spikes, dropouts = find_outliers(replace(record, pressure_pa=pressure_pa), "pressure_pa")
    assert not spikes.any()
    assert {*np.flatnonzero(dropouts)} == {*rows}


def test_the_answer_to_a_pulse_of_the_command_is_no_outlier():
    valve_v, position_m = np.zeros(3000), np.random.default_rng(4).normal(0.0, 1e-6, 3000)
    for start in range(200, 2900, 300):
        valve_v[start : start + 3] = 5.0
        position_m[start + 1 : start + 4] += 0.01
    record = Record("pulses", 0.1 * np.arange(3000), valve_v=valve_v, position_m=position_m)
    assert not np.any(find_outliers(record, "position_m"))


def test_steps_clicks_and_ramps_are_no_outliers():
    t_s = np.arange(6000) * 1e-3
    random = np.random.default_rng(1)
    steps = 0.01 * (np.sin(2 * np.pi * t_s) > 0.0)
    clicks = np.cumsum(random.random(6000) < 0.002) * 1e-4
    buzz = 0.01 * (np.sin(200.0 * np.pi * t_s) > 0.0)
    for motion in (steps, clicks, buzz, np.abs(t_s % 1.0 - 0.5)):
        record = Record("made", t_s, position_m=motion + random.normal(0.0, 1e-6, 6000))
        spikes, dropouts = find_outliers(record, "position_m")
        assert not spikes.any()
        assert not dropouts.any()


def test_scattered_stamps_give_way_to_the_grid_only_if_the_samples_are_regular():
    random = np.random.default_rng(2)
    grid_s = np.arange(5000) * 1e-3
    grid_s[3000:] += 0.0204  # a gap, after which the grid begins anew
    scattered_s = np.sort(grid_s + random.normal(0.0, 2e-4, 5000))
    regular, true = (0.02 * np.sin(4.0 * t) + 1e-6 * random.normal(size=5000)
                     for t in (grid_s, scattered_s))  # fmt: skip
    late, honest = (Record("", scattered_s, position_m=x) for x in (regular, true))
    (times,) = find_regular_times([late])
    assert times is not None
    assert np.std(times - grid_s) < 2e-5
    assert find_regular_times([honest]) == [None]


def test_a_record_that_shows_no_jitter_follows_the_others_of_its_logger():
    random = np.random.default_rng(3)
    grid_s = np.arange(5000) * 1e-3
    scattered_s = np.sort(grid_s + random.normal(0.0, 2e-4, 5000))
    moving = 0.02 * np.sin(4.0 * grid_s) + 1e-6 * random.normal(size=5000)
    late = Record("late", scattered_s, position_m=moving)
    slow = Record("slow", scattered_s, position_m=random.normal(0.0, 1e-6, 5000))
    exact = Record("exact", grid_s, position_m=moving)
    assert find_regular_times([slow, exact]) == [None, None]
    found = find_regular_times([late, slow, exact])
    assert [times is not None for times in found] == [True, True, False]


def test_hum_is_taken_off_and_an_excitation_of_the_same_frequency_is_not():
    record = measured("fit", 7)
    t_s, hum = record.t_s, 600.0 * np.sin(2 * np.pi * 50.02 * record.t_s + 1.0)
    cleaned, found = remove_hum(record["pressure_pa"] + hum, 1e-3, record["valve_v"])
    assert [h.frequency_hz for h in found] == [50.0]
    assert found[0].amplitude == pytest.approx(600.0, rel=0.2)
    assert np.std(cleaned - record["pressure_pa"]) < 0.3 * np.std(hum)
    command = np.where(t_s > 1.0, 2.0 * np.sin(2 * np.pi * 50.0 * t_s), 0.0)
    answer = 1e5 + 2e3 * command + 3e4 * np.sin(t_s)
    answer += np.random.default_rng(3).normal(0.0, 300.0, len(t_s))
    assert remove_hum(answer, 1e-3, command)[1] == []


def test_a_slow_motion_between_two_counts_is_not_held():
    t_s = np.arange(6000) * 1e-3
    position_m = np.round(0.02 * np.sin(2.0 * t_s) / 3e-6) * 3e-6
    assert not np.any(find_outliers(Record("slow", t_s, position_m=position_m), "position_m"))


def test_a_filter_is_found_by_the_noise_of_the_rest():
    record = measured("fit", 4)
    assert not any(is_filtered(record, c) for c in ("pressure_pa", "position_m"))
    smoothed = filtfilt(*butter(2, 0.06), record["pressure_pa"])
    (_,), faults = mend_records([replace(record, pressure_pa=smoothed)])
    assert [(f.channel, f.kind) for f in faults] == [("pressure_pa", "filtered")]
    walk = 1e5 + np.cumsum(np.random.default_rng(6).normal(0.0, 10.0, len(record)))
    assert not is_filtered(replace(record, pressure_pa=walk), "pressure_pa")


def test_a_change_counts_at_each_scale_where_half_of_its_samples_do():
    record = measured("fit", 7)
    counts = np.random.default_rng(1).random(len(record)) > 0.4
    weigher, _ = prepare_weigher([replace(record, counts=counts)], (), PlantSettings())
    seen, kept = ~weigher.train.hidden, weigher.like.keep
    at, samples = 0, 2
    while samples <= weigher.train.block:
        shares = seen.reshape(*seen.shape[:2], -1, samples).mean(axis=-1)
        end = at + shares.shape[-1]
        assert np.array_equal(kept[..., at:end], shares >= 0.5), samples
        at, samples = end, 2 * samples
    assert 0.0 < kept.mean() < 1.0


# --- zeros that homing left ----------------------------------------------------------------------

ATMOSPHERE_PA, NOISE_PA, AMPLITUDE_PA = 101325.0, 150.0, 3e5


def rest_and_move(
    zero_pa: float,
    seed: int,
    *,
    rest_s: float = 1.0,
    resting_v: float = 0.0,
    leak_pa: float = 0.0,
    decay_pa: float = 0.0,
    noise_pa: float = NOISE_PA,
) -> Record:
    """Rest, then follow a sine. A leak fills the muscle at rest, or it still empties."""
    t_s = np.arange(0.0, 4.0, 1e-3)
    moving_s = np.maximum(t_s - rest_s, 0.0)
    swing = 1.0 - np.cos(2.0 * np.pi * moving_s)
    air_pa = leak_pa * (1.0 - np.exp(-t_s / 0.3)) + decay_pa * np.exp(-t_s / 0.3)
    noise = np.random.default_rng(seed).normal(0.0, noise_pa, len(t_s))
    return Record(
        f"rest-{seed}",
        t_s,
        valve_v=np.where(t_s < rest_s, resting_v, 1.0),
        pressure_pa=ATMOSPHERE_PA + zero_pa + air_pa + AMPLITUDE_PA * swing + noise,
        position_m=0.01 * swing,
    )


def find_shifts(records: list[Record]) -> list[float]:
    """By how much each record's pressure was lowered; the same for all its samples."""
    aligned = align_resting_pressure(records)
    lowered = [r["pressure_pa"] - a["pressure_pa"] for r, a in zip(records, aligned, strict=True)]
    assert all(np.ptp(each) < 1e-6 for each in lowered)
    return [float(each[0]) for each in lowered]


def test_zeros_are_aligned_to_their_median_and_the_common_offset_stays():
    zeros = (240.0, 160.0, 320.0)
    shifts = find_shifts([rest_and_move(zero, k) for k, zero in enumerate(zeros)])
    # Of 1000 samples the mean is uncertain by 5 Pa, a difference by some 7 Pa.
    assert shifts == pytest.approx([0.0, -80.0, 80.0], abs=20.0)


def test_a_shared_leak_is_no_difference_however_long_the_rests_are():
    """The mean over the longer rest is 34 Pa higher, since the muscle is filled by then."""
    records = [
        rest_and_move(0.0, 1, rest_s=0.5, leak_pa=100.0, noise_pa=1.0),
        rest_and_move(0.0, 2, rest_s=2.0, leak_pa=100.0, noise_pa=1.0),
    ]
    assert find_shifts(records) == pytest.approx([0.0, 0.0], abs=1.0)


@pytest.mark.parametrize(
    "other",
    [
        rest_and_move(0.0, 2, decay_pa=400.0),  # it still empties: no rest
        rest_and_move(700.0, 2),  # more than homing leaves
        rest_and_move(80.0, 2, rest_s=0.05),  # too short to say
        rest_and_move(80.0, 2, resting_v=-5.0),  # an open exhaust: another rest
        replace(rest_and_move(80.0, 2), valve_v=None),  # a pressure that holds may be any
    ],
    ids=["empties", "too far", "too short", "other command", "no command"],
)
def test_what_is_no_matter_of_homing_stays(other):
    assert find_shifts([rest_and_move(0.0, 1), other]) == [0.0, 0.0]


@pytest.mark.parametrize("mended", ["hum", "zero"])
def test_a_column_that_is_mended_off_its_converters_steps_keeps_their_size(mended):
    is_hum, step_pa = mended == "hum", 400.0
    records = [measured("fit", 7)] if is_hum else [rest_and_move(80.0 * k, k) for k in range(3)]
    for k, record in enumerate(records):
        hum = is_hum * 600.0 * np.sin(2 * np.pi * 50.02 * record.t_s + 1.0)
        rounded_pa = np.round((record["pressure_pa"] + hum) / step_pa) * step_pa
        records[k] = replace(record, pressure_pa=rounded_pa)
    records, faults = mend_records(records) if is_hum else (align_resting_pressure(records), [])
    assert [(f.channel, f.kind) for f in faults] == is_hum * [("pressure_pa", "hum")]
    assert any(record["pressure_pa"][0] % step_pa for record in records)
    assert [r.find_step("pressure_pa") for r in records] == pytest.approx(len(records) * [step_pa])
    weigher, _ = prepare_weigher(records, (), PlantSettings())
    at = weigher.train.channels.index("pressure_pa")
    assert np.sqrt(12.0 * weigher.like.least2[at]) == pytest.approx(step_pa)


def test_equal_zeros_are_hardly_moved_by_the_noise_of_the_rests():
    pairs = [[rest_and_move(0.0, 2 * k), rest_and_move(0.0, 2 * k + 1)] for k in range(40)]
    moved = np.array([find_shifts(pair)[0] for pair in pairs])
    # Half the difference of two means of 1000 samples; what noise explains is not taken off.
    assert np.sqrt(np.mean(moved**2)) < NOISE_PA / np.sqrt(2.0 * 1000)
    assert np.mean(moved == 0.0) > 0.5


# --- the noise of a channel ----------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [1000.0, 100.0])
@pytest.mark.parametrize("step_m", [0.0, 2.3e-4])
def test_white_noise_is_read_from_a_signal_that_never_rests(rate_hz, step_m):
    t_s = np.arange(8.0 * rate_hz) / rate_hz
    motion_m = 0.01 * np.sin(2.0 * t_s) + 0.004 * np.sin(9.0 * t_s + 1.0)
    position_m = motion_m + np.random.default_rng(0).normal(0.0, 1e-4, len(t_s))
    if step_m:
        position_m = np.round(position_m / step_m) * step_m
    total_m = np.hypot(1e-4, step_m / np.sqrt(12.0))
    assert estimate_white_noise(position_m) == pytest.approx(total_m, rel=0.08)


def test_stated_noise_comes_from_the_option_the_plant_file_or_the_import_map(tmp_path):
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
def test_the_document_says_where_noise_comes_from(by):
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


def test_the_rounding_of_a_slow_signal_is_slow():
    """A coarse converter shows a still signal off by one amount, not by noise."""
    coarse = SensorNoise(0.0, 100.0)
    random = np.random.default_rng(5)
    still = np.full(50, 123.0)
    errors = np.array([coarse.simulate_sensor(still, random) - still for _ in range(400)])
    assert np.all(np.ptp(errors, axis=1) == 0.0)
    assert np.std(errors[:, 0]) == pytest.approx(100.0 / np.sqrt(12.0), rel=0.1)
