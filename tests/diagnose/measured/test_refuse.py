"""Data that would mislead are refused with the reason."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal
from support.cylinder import LiftingMuscle
from support.made_records import PERIOD_S, measured, pair

import pamctl
from pamctl.control.experiment import plan_experiment
from pamctl.diagnose import Record, Verdict, diagnose
from pamctl.diagnose.read_record import record_of
from pamctl.diagnose.record_doubts import (
    doubt_actuator,
    doubt_excitation,
    doubt_record,
    doubt_sensors,
)
from pamctl.diagnose.refuse import (
    RULES,
    BadData,
    UnknownRule,
    check_measured_runs,
    read_acceptances,
)
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.time_shifts import check_time_shifts
from pamctl.log.importing.column_map import ImportMap, PressureMap, TimeMap
from pamctl.log.importing.pipeline import import_log
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings
from pamctl.plant.parameters import parameters_of
from pamctl.settings.config_files import config_dir
from pamctl.settings.resolve import read_section_file

PAPER = PlantSettings()
DIRECT = PlantSettings.model_validate(
    {
        "actuator": "direct",
        "parameters": {"mass_kg": 1.0, "damping_n_s_per_m": 10.0, "stiffness_n_per_m": 100.0},
    }
)
CHAMBER = PlantSettings.model_validate({"actuator": "chamber", "chamber_volume_m3": 1e-3})


def spoilt(**changes: object) -> str:
    """Return why a record with these columns is refused."""
    record = replace(measured("fit", 1), **changes)  # type: ignore[arg-type]
    found = diagnose([record], [measured("judge", 2)], PAPER)
    assert found.verdict is Verdict.BAD_DATA
    assert build_diagnosis_document(found)["reason"] == found.reason
    return found.reason


@pytest.mark.long
def test_data_that_would_mislead_are_refused_with_the_reason():
    good = measured("fit", 1)
    pressure, position, command = good["pressure_pa"], good["position_m"], good["valve_v"]
    assert "kPa" in spoilt(pressure_pa=pressure * 1e-3)
    assert "gauge" in spoilt(pressure_pa=pressure - 101.3e3)
    assert "is its sign turned" in spoilt(pressure_pa=-pressure)
    assert "mm or counts" in spoilt(position_m=position * 1e3)
    assert "driver's offset" in spoilt(valve_v=command + 5.0)
    assert "clipped" in spoilt(pressure_pa=np.minimum(pressure, 350e3))
    shredded = np.arange(len(good)) * PERIOD_S + np.arange(len(good)) // 15 * 0.2
    assert "leave no stretch of 20 samples" in spoilt(t_s=shredded)
    assert "pressure_pa answers 4" in spoilt(pressure_pa=np.roll(pressure, 40))
    assert "ms before valve_v" in spoilt(pressure_pa=np.roll(pressure, -20))
    assert "ms before pressure_pa" in spoilt(position_m=np.roll(position, -60))
    assert "ms after pressure_pa" in spoilt(
        position_m=np.concatenate([np.zeros(110), position[:-110]])
    )
    broken = position.copy()
    broken[77::5] = np.nan
    assert "the first is row 77" in spoilt(position_m=broken)


def test_the_longest_lags_of_the_catalogue_are_not_taken_for_a_shifted_column():
    lags = {
        "command_delay__delay_s": 0.02,
        "valve_spool__time_constant_s": 0.005,
        "bladder_threshold__pressure_pa": 60e3,
        "coulomb_friction__force_n": 40.0,
        "damping_n_s_per_m": 1200.0,
    }
    for hidden in (lags, {"pressure_sensor_lag__time_constant_s": 0.02}, {}):
        assert [*check_time_shifts(measured("fit", **hidden))] == []


def test_a_channel_that_stands_still_is_refused():
    still = [replace(r, position_m=np.full(len(r), 1e-3)) for r in pair()[0]]
    assert "not excited" in diagnose(still, still, PAPER).reason


def test_columns_are_any_numbers_and_raise_an_error_where_lengths_differ():
    with pytest.raises(ValueError, match="3 samples"):
        Record("short", np.arange(4) * PERIOD_S, valve_v=np.zeros(3))
    assert Record("plain", [0, 1, 2], position_m=[0, 1, 2]).step_s.tolist() == [1.0, 1.0]


def test_gaps_cut_a_record_into_segments_and_do_not_refuse_it():
    good = measured("fit", 1)
    t_s = good.t_s.copy()
    t_s[2000:] += 0.3
    t_s[4000:] += 0.04
    paused = replace(good, t_s=t_s)
    # A command holds over 40 missed ticks; a force that was not sampled does not.
    assert paused.segments == (slice(0, 2000), slice(2000, len(good)))
    assert len(replace(paused, valve_v=None).segments) == 3
    assert check_measured_runs([paused], PAPER) == ()
    assert good.segments == (slice(0, len(good)),)


def sines(rate_hz: float, **columns: float) -> Record:
    """Return slow sines of these amplitudes with a little noise, 20 s long."""
    t_s = np.arange(round(20.0 * rate_hz)) / rate_hz
    random = np.random.default_rng(5)
    return Record(
        "sines",
        t_s,
        **{
            name: size * (np.sin(0.9 * t_s) + 1e-4 * random.normal(size=len(t_s)))
            for name, size in columns.items()
        },
    )


def test_a_mechanism_without_a_muscle_is_not_measured_by_the_muscle():
    for rate_hz in (10.0, 100.0, 1000.0):
        axis = sines(rate_hz, force_n=1e-3, position_m=0.3)
        assert check_measured_runs([axis], DIRECT) == ()
    held = replace(axis, pressure_pa=np.full(len(axis), 8e5))
    assert check_measured_runs([held], DIRECT) == ()
    gauge = replace(axis, pressure_pa=np.linspace(1e4, 7e5, len(axis)))
    assert [d.key for d in doubt_record(gauge, DIRECT)] == ["pressure_unit"]
    flat = replace(axis, force_n=np.random.default_rng(1).normal(size=len(axis)))
    assert [d.key for d in doubt_excitation([flat], DIRECT)] == ["still"]


def test_a_record_of_something_else_than_the_plant_file_says_is_refused_at_once():
    muscle = sines(500.0, valve_v=2.0, position_m=0.01)
    air = np.linspace(1.2e5, 3e5, len(muscle))
    muscle = replace(muscle, pressure_pa=air)
    told = [diagnose([muscle], [muscle], plant).reason for plant in (CHAMBER, DIRECT)]
    assert "sines: position_m moves by 20 mm" in told[0]
    assert "`pamctl plant new`" in told[0]
    assert "`actuator: direct`, which force_n must drive; the record holds valve_v, p" in told[1]
    axis = sines(500.0, force_n=10.0, position_m=0.01)
    assert "valve_v or pressure_pa must drive" in diagnose([axis], [axis], PAPER).reason
    piston = DIRECT.model_validate(
        {**DIRECT.model_dump(), "effects": {"piston": {"area_m2": 1e-4}}}
    )
    clamped = replace(muscle, position_m=1e-6 * np.random.default_rng(1).normal(size=len(muscle)))
    for record, plant in ((muscle, PAPER), (muscle, piston), (clamped, CHAMBER), (axis, DIRECT)):
        assert [*doubt_actuator(record, plant)] == []


def test_a_motion_beyond_the_stops_of_the_plant_file_is_refused_with_both_figures():
    muscle = sines(500.0, valve_v=2.0, position_m=0.01)  # 20 mm from end to end
    short, long = (PAPER.model_copy(update={"stroke_m": stroke_m}) for stroke_m in (0.015, 0.0195))
    (doubt,) = doubt_actuator(muscle, short)
    assert "moves by 20 mm, and the plant file's stroke_m is 15 mm" in doubt.message
    assert [*doubt_actuator(muscle, long)] == []


@pytest.mark.parametrize("plant", [PAPER, DIRECT])
def test_noise_alone_is_a_record_in_which_nothing_moves_and_not_one_that_is_coarse(plant):
    noise = np.random.default_rng(3).normal(size=(4, 1100))
    columns = {"valve_v": np.zeros(1100), "pressure_pa": 2e5 + 200.0 * noise[0]}
    if plant is DIRECT:
        columns = {"force_n": noise[2]}
    still = Record("still", np.arange(1100) * 0.002, position_m=1e-5 * noise[1], **columns)
    assert [*doubt_record(still, plant)] == []
    told = diagnose([still], [still], plant).reason
    assert "coarse" not in told
    assert told.count("--accept still=REASON") == len(still.channels)


def test_a_rate_at_which_the_pressure_jumps_is_doubted_but_a_spike_is_not():
    good = measured("squares", 1)
    assert [*doubt_record(good, PAPER)] == []
    every = slice(0, None, 100)
    coarse = Record("coarse", good.t_s[every], good["valve_v"][every], good["pressure_pa"][every])
    assert "coarse" in [d.key for d in doubt_record(coarse, PAPER)]
    spiky = good["pressure_pa"].copy()
    spiky[1234] += 1e6
    assert "coarse" not in [d.key for d in doubt_record(replace(good, pressure_pa=spiky), PAPER)]


@pytest.mark.parametrize("program", ["multisine", "steps", "ramps"])
def test_the_set_point_of_a_pressure_regulator_is_no_command_of_a_valve(program):
    t_s, random = np.arange(3500) * 4e-3, np.random.default_rng(3)
    set_v = {
        "multisine": 5.0 + sum(np.sin(2.0 * np.pi * hz * t_s + 9.0 * hz) for hz in (0.2, 0.7, 2.6)),
        "steps": np.repeat(random.uniform(1.0, 9.0, 14), 250),
        "ramps": np.interp(t_s, [0.0, 4.0, 8.0, 14.0], [1.0, 9.0, 2.0, 8.0]),
    }[program]
    answers = signal.StateSpace(*signal.tf2ss([22.0**2], [1.0, 2 * 0.65 * 22.0, 22.0**2]))
    _, bar, _ = signal.lsim(answers, 0.6 * (set_v - set_v[0]), t_s)
    pressure_pa = 1e5 * (1.013 + 0.6 * set_v[0] + bar) + random.normal(0.0, 120.0, len(t_s))
    told = [*doubt_record(Record("a", t_s, set_v - 5.0, pressure_pa), PAPER)]
    assert [d.key for d in told] == ["regulator"]
    assert "leave the column out of the map" in told[0].sentence
    assert [*doubt_record(Record("a", t_s, None, pressure_pa), PAPER)] == []


@pytest.mark.parametrize("leak_m2", [0.0, 3e-7])
def test_the_command_of_a_valve_is_no_set_point_in_any_shipped_program(leak_m2):
    truth = parameters_of({"valve_leak.area_m2": leak_m2})
    told = 0
    for path in sorted((config_dir() / "experiment").glob("*.yaml")):
        plan = plan_experiment(read_section_file("experiment", path)).segments
        volts = np.concatenate([np.full(round(1e3 * s.duration_s), s.valve_v) for s in plan])
        if not np.isfinite(volts).all() or np.ptp(volts) == 0.0:
            continue  # a closed loop's
        volts = volts[:20_000]
        driven = drive_coupled(truth, volts, PERIOD_S)
        record = Record(path.stem, np.arange(len(volts)) * PERIOD_S, volts, driven.pressure_pa)
        assert "regulator" not in [d.key for d in doubt_record(record, PAPER)], path.stem
        told += 1
    assert told >= 10


def test_the_levels_of_a_valve_that_switches_are_to_be_mapped():
    good = measured("squares", 1)
    fills = (good["valve_v"] > 0.0).astype(float)
    assert [d.key for d in doubt_record(replace(good, valve_v=10.0 * fills - 5.0), PAPER)] == []
    noise = 0.02 * np.random.default_rng(1).standard_normal(len(good))
    for volts in (3.3, 5.0, 10.0, 24.0):
        for on_off, empties in ((fills, 0.0), (1.0 - fills, volts)):  # in both polarities
            for measured_v in (volts * on_off, volts * on_off + noise):
                (doubt,) = doubt_record(replace(good, valve_v=measured_v), PAPER)
                assert doubt.key == "command_unit"
                told = float(doubt.sentence.split("loses its air while it is ")[1].split(";")[0])
                assert told == pytest.approx(empties, abs=0.15)
                assert "offset -5" not in doubt.sentence


def test_a_slow_chamber_may_answer_later_than_a_fast_one():
    t_s = np.arange(0.0, 8.0, 1e-3)
    command = np.where(t_s > 1.0, 5.0, 0.0)
    for half_s, delay_s, refused in ((0.3, 0.0, 0), (0.3, 0.02, 0), (0.02, 0.05, 1)):
        since = np.maximum(t_s - 1.0 - delay_s, 0.0)
        filling = 101e3 + 3e5 * since**2 / (half_s**2 + since**2)
        record = Record("filling", t_s, valve_v=command, pressure_pa=filling)
        assert len([*check_time_shifts(record)]) == refused


def test_a_later_command_is_not_taken_for_a_late_answer():
    t_s = np.arange(0.0, 8.0, 1e-3)
    filling = 101e3 + 3e5 * np.maximum(np.tanh((t_s - 1.12) / 0.05), 0.0)
    for first_v, refused in ((5.0, 1), (-5.0, 0)):  # the second opens further, or opens first
        command = np.select([t_s > 1.12, t_s > 1.0], [5.0, first_v], -1.0)
        record = Record("filling", t_s, valve_v=command, pressure_pa=filling)
        assert len([*check_time_shifts(record)]) == refused


def test_a_doubt_is_overruled_with_a_reason_that_is_kept():
    good = measured("fit", 1)
    spoilt_record = replace(good, valve_v=good["valve_v"] + 5.0)
    with pytest.raises(BadData, match=r"--accept command_unit=REASON"):
        check_measured_runs([spoilt_record], PAPER)
    (accepted,) = check_measured_runs([spoilt_record], PAPER, {"command_unit": "0 to 10 V here"})
    assert accepted.as_dict()["reason"] == "0 to 10 V here"
    assert "output voltage" in accepted.doubts[0]
    assert read_acceptances(["gap = the logger paused"]) == {"gap": "the logger paused"}
    with pytest.raises(UnknownRule, match="did you mean clipped"):
        read_acceptances(["cliped=it is so"])
    with pytest.raises(UnknownRule, match="say why"):
        read_acceptances(["gap"])


def test_the_manual_lists_every_rule():
    page = (Path(pamctl.__file__).parent / "manual/how_to/diagnose-a-log.md").read_text()
    assert [name for name in RULES if f"`{name}`" not in page] == []


@pytest.mark.parametrize(("atmosphere_pa", "is_told"), [(95e3, True), (101.3e3, False)])
def test_an_atmosphere_of_the_import_map_that_is_not_the_plants_is_said(
    tmp_path, atmosphere_pa, is_told
):
    t_s = np.arange(50) * 0.01
    table = tmp_path / "a.csv"
    rows = np.column_stack([t_s, 2.0 + np.sin(9.0 * t_s)])
    np.savetxt(table, rows, delimiter=",", header="t_s,p", comments="")
    pressure = PressureMap(column="p", unit="bar", gauge=True)
    import_map = ImportMap(
        time=TimeMap(column="t_s"), pressure=pressure, atmospheric_pressure_pa=atmosphere_pa
    )
    import_log(table, tmp_path / "a.mcap", import_map)
    lines: list[str] = []
    diagnose([record_of(tmp_path / "a.mcap")], [], PAPER, progress=lines.append)
    assert any("counts from 95000 Pa" in line for line in lines) == is_told


def test_a_load_that_waits_on_its_floor_is_no_late_column_where_the_plant_file_has_the_stop():
    """The muscle carries it from 1.2 bar on, which takes the valve longer than a sensor may."""
    muscle, t_s = LiftingMuscle(gain_m2_per_v=1e-7), np.arange(0.0, 6.0, 1e-3)
    commands = np.where(t_s % 3.0 < 1.0, -2.0, np.where(t_s % 3.0 < 2.0, 3.0, -3.0))
    position_m, pressure_pa = muscle.simulate(t_s, commands)
    lifted = Record("lifted", t_s, commands, pressure_pa, np.round(position_m / 1e-6) * 1e-6)
    plant = muscle.plant()
    assert check_measured_runs([lifted], plant) == ()
    without = plant.model_copy(update={"stroke_m": None})
    with pytest.raises(BadData, match="where a stop held it, give the plant file stroke_m"):
        check_measured_runs([lifted], without)


def test_a_muscle_that_friction_holds_at_its_highest_is_not_clipped_and_one_cut_in_motion_is() -> (
    None
):
    t_s = np.arange(0.0, 10.0, 1e-3)
    phase = (0.4 * t_s) % 1.0
    braked = 0.5 - 0.5 * np.cos(np.pi * np.minimum(np.minimum(phase, 1.0 - phase) / 0.4, 1.0))
    pressure_pa = 3e5 + 1.5e5 * np.sin(2.0 * np.pi * phase)
    for shape, rules in ((braked, []), (np.minimum(1.5 * np.sin(np.pi * phase), 1.0), ["clipped"])):
        position_m = 3e-6 * np.round(0.02 * shape / 3e-6)
        record = Record("top", t_s, pressure_pa=pressure_pa, position_m=position_m)
        assert [d.key for d in doubt_sensors(record, PAPER)] == rules
