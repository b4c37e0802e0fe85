"""Experiments made of forms through the command line: run, replay, refused beforehand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat
from typer.testing import CliRunner, Result

from pamctl.cli.app import app
from pamctl.log.reader import Log, read
from pamctl.offline.tick_replay import replay_log
from pamctl.signals import Phase

NO_HOMING = ("--set", "rig.homing.enabled=false")

SHORT: dict[str, list[str]] = {"sine": ["cycles=1", "frequency_hz=2"], "valve-sine": ["cycles=2"]}


def fast_run(log: Path, *arguments: str) -> Result:
    options = ["run", "--fast", "--json", "--log", str(log), *NO_HOMING, *arguments]
    return CliRunner().invoke(app, options)


def run_whole(log: Path, *arguments: str) -> Log:
    done = fast_run(log, *arguments)
    assert done.exit_code == 0, done.stderr
    return read(log)


def dry_run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["run", "--fast", "--dry-run", *arguments])


def write_table(folder: Path, text: str, **keys: Any) -> str:
    """Write a table and its experiment; return the experiment's path."""
    (folder / "points.csv").write_text(text)
    path = folder / "mine.yaml"
    path.write_text(json.dumps({"kind": "table", "file": "points.csv", **keys}))
    return str(path)


@pytest.mark.long
@pytest.mark.parametrize("name", SHORT)
def test_a_form_runs_and_replays_to_the_bit(name, tmp_path):
    changes = [part for key in SHORT[name] for part in ("--set", f"experiment.{key}")]
    log = run_whole(tmp_path / "run.mcap", "--experiment", name, *changes)
    replay = replay_log(log)
    assert replay.is_equal
    assert replay.is_whole
    if name == "valve-sine":
        assert np.isfinite(log["reference_valve_v"]).all()
    else:
        tracked = log["phase"] == Phase.TRACK
        assert tracked.any()
        error_m = np.abs(log["position_m"] - log["reference_m"])[tracked]
        assert error_m.max() < 0.5e-3


def test_a_sequence_puts_its_marks_and_gains_into_the_log(tmp_path):
    path = tmp_path / "mine.yaml"
    parts = [
        {"kind": "mark", "text": "begin"},
        {"kind": "sine", "offset_mm": 9, "amplitude_mm": 1, "frequency_hz": 2, "cycles": 3,
         "trigger": "camera"},
        {"kind": "gains", "set": {"lambda_per_s": 5.0}, "ramp_s": 0.2},
        {"kind": "move", "to_mm": 10, "duration_s": 1},
        {"kind": "mark", "text": "end"},
        {"kind": "pause", "duration_s": 0.1},
    ]  # fmt: skip
    path.write_text(json.dumps({"kind": "sequence", "parts": parts}))
    log = run_whole(tmp_path / "run.mcap", "--experiment", str(path))
    marks = [event for event in log.events if event["event"] == "mark"]
    assert [m["text"] for m in marks] == ["begin", "camera 1", "camera 2", "camera 3", "end"]
    at_s = [float(log.t[np.searchsorted(log["tick"], mark["tick"])]) for mark in marks]
    # An approach of 5 s, 2 s to settle, and one period in which the sine grows.
    assert at_s[1:4] == pytest.approx([7.5, 8.0, 8.5], abs=1.1e-3)
    assert len(log.gains) == 2
    assert log.gains[1]["lambda_per_s"] == 5.0
    assert replay_log(log).is_equal


def test_a_table_runs_without_its_file_from_the_log_alone(tmp_path):
    text = "time_ms,displacement_um\n0,9000\n500,9500\n1000,11000\n2000,10000\n"
    experiment = write_table(tmp_path, text)
    log = run_whole(tmp_path / "run.mcap", "--experiment", experiment)
    (tmp_path / "points.csv").unlink()
    assert replay_log(log).is_equal
    course = log["reference_m"][7000:9000]
    assert course[[0, 500, 1000]] == pytest.approx([0.009, 0.0095, 0.011], abs=1e-9)


def test_a_mat_file_is_a_table_too(tmp_path):
    t_s = np.linspace(0, 2, 41)
    ramp = 0.5 - 0.5 * np.cos(np.pi * t_s / 2)
    savemat(tmp_path / "points.mat", {"tout": t_s, "yout": np.column_stack([ramp, 9 + ramp])})
    keys = {"time_column": "tout", "value_column": "yout(:,2)", "unit": "mm"}
    path = tmp_path / "mine.yaml"
    path.write_text(json.dumps({"kind": "table", "file": "points.mat", **keys}))
    done = dry_run("--experiment", str(path), "--json")
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout)["experiment"]["values_mm"][-1] == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("text", "keys", "said"),
    [
        (
            "time_s,position_mm\n0,8\n1,nan\n2,9\n",
            {},
            "points.csv:3: rows without a finite number: 1",
        ),
        ("time_s,position_mm\n0,8\n", {}, "has 1 row; a table needs two"),
        ("time_s,position_mm\n0,8\n2,9\n1,9\n", {}, "points.csv:4: time must rise, but 1 s"),
        ("time_s,position_kPa\n0,8\n2,9\n", {}, "give value_column"),
        (
            "a,b\n0,8\n2,9\n",
            {},
            "states a time; give time_column; no column's name states this quantity with its unit "
            "(m, mm, cm, um, in); give value_column and unit; the columns are a, b",
        ),
        ("time_s,x\n0,8\n2,9\n", {"value_column": "x"}, "states no unit; give unit"),
        ("time_s,x\n0,8\n2,9\n", {"value_column": "x", "unit": "ft"}, "'ft' is none of m, mm"),
        ("time_s,x\n0,8\n2,9\n", {"value_column": "y", "unit": "mm"}, "no column 'y'"),
        ("time_s,position_mm\n0,8\n1,bla\n", {}, "points.csv:3: position_mm is 'bla'"),
        ("", {}, "is empty"),
        (
            "time_s,position_mm\n" + "".join(f"{i},8\n" for i in range(20_000)),
            {},
            "20000 points, more than 8000; take each n-th row with every: 3",
        ),
    ],
)
def test_a_bad_table_is_refused_in_one_line(text, keys, said, tmp_path):
    done = dry_run("--experiment", write_table(tmp_path, text, **keys))
    assert done.exit_code == 78
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_huge_or_irregular_file_is_not_read(tmp_path):
    experiment = write_table(tmp_path, "")
    with (tmp_path / "points.csv").open("wb") as file:
        file.truncate(60_000_000)
    assert "has 60 MB, more than 50" in dry_run("--experiment", experiment).stderr
    path = tmp_path / "zero.yaml"
    for file_name, said in (
        ("/dev/zero", "it is a device"),
        (str(tmp_path), "it is a directory"),
        ("none.csv", "No such file"),
        ("mine.yaml", "neither a .csv nor a .mat"),
    ):
        path.write_text(json.dumps({"kind": "table", "file": file_name}))
        assert said in dry_run("--experiment", str(path)).stderr


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (["amplitude_mm=20"], "a position of -8.2 mm at 18.5 s;"),  # 11.5 s after the approach of 7
        (["amplitude_mm=4", "frequency_hz=25"], "an acceleration of"),
        (["offset_mm=3", "amplitude_mm=2.9", "frequency_hz=4"], "a pressure of"),
        (["amplitude_mm=3", "frequency_hz=6"], "a valve command of"),
    ],
)
def test_a_sine_beyond_the_envelope_is_refused_with_the_figure(changes, said):
    sets = [part for change in changes for part in ("--set", f"experiment.{change}")]
    done = dry_run("--experiment", "sine", *sets)
    assert done.exit_code == 78
    assert said in done.stderr
    assert "the limits are" in done.stderr


def test_the_limits_of_the_envelope_are_keys_of_the_rig():
    slow = ("--set", "rig.envelope.speed_mm_per_s=5")
    done = dry_run("--experiment", "sine", *slow)
    # 2 mm at 0.5 Hz: 6.28 mm/s, and a little more while it grows.
    assert "a speed of 6.2" in done.stderr or "a speed of -6.2" in done.stderr
    assert "the limits are -5 to 5 (" in done.stderr
    assert dry_run("--experiment", "sine").exit_code == 0


def test_the_model_needs_the_valve_command_that_the_simulated_muscle_gets(tmp_path):
    """The demand that refuses is right where it does not: within a tenth of what the law uses."""
    from pamctl.control.experiment import plan_experiment
    from pamctl.plant.model import plant_parameters
    from pamctl.settings.envelope import find_demand, sample_segments
    from pamctl.settings.resolve import resolve

    changes = ["experiment.frequency_hz=2", "experiment.cycles=4", "experiment.amplitude_mm=3"]
    settings = resolve(experiment="sine", overrides=changes)
    log = run_whole(
        tmp_path / "run.mcap", "--experiment", "sine",
        *(part for change in changes for part in ("--set", change)),
    )  # fmt: skip
    model = plant_parameters(settings.plant).paper
    samples = sample_segments(plan_experiment(settings.experiment).segments, 1e9)
    full = [s for s in samples if s.reference.phase == Phase.TRACK]
    needed = [find_demand(model, sample) for sample in full]
    tracked = log["phase"] == Phase.TRACK
    used_pa = log["true_pressure_pa"][tracked]
    assert max(d.pressure_pa for d in needed) == pytest.approx(used_pa.max(), rel=0.05)
    assert min(d.pressure_pa for d in needed) == pytest.approx(used_pa.min(), rel=0.05)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"length_unit": "inch"}, "takes effect with the next run"),
        ({"lambda_per_s": -3}, "lambda_per_s: Input should be greater than"),
        ({"lpf1_hz": 800}, "is above"),
        ({"typo": 3}, "typo: Extra inputs are not permitted"),
    ],
)
def test_a_gain_that_cannot_change_while_it_runs_is_refused(change, said, tmp_path):
    path = tmp_path / "mine.yaml"
    parts = [{"kind": "move", "to_mm": 5, "duration_s": 2}, {"kind": "gains", "set": change}]
    path.write_text(json.dumps({"kind": "sequence", "parts": parts}))
    done = dry_run("--experiment", str(path))
    assert done.exit_code == 78
    assert said in done.stderr


CORNERS = "time_s,position_mm\n0,20\n1,20\n1.6,55\n3,55\n4,30\n6,30\n"
SOFT = "time_s,position_mm\n0,8\n1,9\n2,11\n3,10\n"


@pytest.mark.parametrize(("points", "is_told"), [(CORNERS, True), (SOFT, False)])
def test_a_curve_that_leaves_the_range_of_its_points_is_told_with_both_ranges(
    tmp_path, points, is_told
):
    mine = write_table(tmp_path, points)
    room = ("--set", "rig.limits.stroke_high_mm=90")
    told = [
        CliRunner().invoke(app, ["config", "check", mine]).stderr,
        dry_run("--experiment", mine, *room).stderr,
    ]
    said = "runs from 13.57 to 69.78 mm, beyond the points' own 20 to 55 mm"
    assert [said in each for each in told] == [is_told, is_told]
    assert [each.count("warning: ") for each in told] == [is_told, is_told]
