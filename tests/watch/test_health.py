"""The health of a rig: what drifts is named, what does not is not."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hidden.excitations import tracking
from hidden.rig import HiddenRig, hidden_rig
from support.command_line import run_pamctl

from pamctl.diagnose.plant_numbers import FittedNumber
from pamctl.diagnose.record import Record
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings
from pamctl.settings.resolve import read_section_file
from pamctl.watch.follow_health import (
    MISFIT,
    SIGMAS_OF_CI90,
    FittedRun,
    FollowedDrift,
    NumberDrift,
    find_changes,
    find_drift,
    fit_record,
)
from pamctl.watch.health_words import _place_runs, describe_drift, list_rivals


def make_numbers(values: np.ndarray, sigma: float) -> list[FittedNumber]:
    half = SIGMAS_OF_CI90 * sigma
    return [FittedNumber("k", float(v), float(v) - half, float(v) + half, "N/m") for v in values]


def test_numbers_that_only_scatter_do_not_drift():
    random = np.random.default_rng(4)
    alarms = 0
    for trial in range(300):
        count = 2 + trial % 10
        values = 100.0 + random.normal(0.0, 1.0, count)
        alarms += find_drift("k", make_numbers(values, 1.0), range(count)) is not None
    assert alarms <= 3


def test_a_step_is_found_where_it_is():
    random = np.random.default_rng(5)
    values = 100.0 + random.normal(0.0, 1.0, 12) + np.where(np.arange(12) >= 7, -8.0, 0.0)
    drift = find_drift("k", make_numbers(values, 1.0), range(12))
    assert drift is not None
    assert (drift.kind, drift.first, drift.second) == ("step", 6, 7)
    assert drift.relative == pytest.approx(-0.08, abs=0.02)


def test_a_trend_is_no_step():
    random = np.random.default_rng(6)
    days = np.arange(12.0)
    values = 100.0 + random.normal(0.0, 1.0, 12) + 1.5 * days
    drift = find_drift("k", make_numbers(values, 1.0), list(days * 86400.0))
    assert drift is not None
    assert drift.kind == "trend"
    assert drift.after - drift.before == pytest.approx(16.5, rel=0.2)


def test_intervals_that_are_too_narrow_are_widened_by_the_scatter_of_neighbours():
    random = np.random.default_rng(7)
    alarms = 0
    for _ in range(100):
        values = 100.0 + random.normal(0.0, 5.0, 12)
        alarms += find_drift("k", make_numbers(values, 1.0), range(12)) is not None
    assert alarms <= 5


@pytest.mark.parametrize("name", ["tank_pressure_pa", "valve_gain_m2_per_v", "braid_length_m"])
def test_a_number_of_the_air_is_said_with_the_effects_that_look_the_same(name):
    """A small leak and a moved null lower the fitted tank pressure, and leave no misfit."""
    runs = [FittedRun("a.mcap", 0.0), FittedRun("b.mcap", 100.0)]
    change = NumberDrift(name, "step", 0, 1, 4.4e5, 4.3e5, "Pa", 9.0)
    drift = FollowedDrift(change, is_doubtful=False)
    said = describe_drift(drift, runs)
    rivals = ("chamber_leak", "valve_leak", "null_offset")
    assert f", or {', or '.join(rivals)} " in said
    assert list_rivals(drift) == rivals
    assert set(rivals) <= set(CATALOGUE)


def test_a_number_of_the_mechanics_is_said_alone():
    runs = [FittedRun("a.mcap", 0.0), FittedRun("b.mcap", 100.0)]
    change = NumberDrift("stiffness_n_per_m", "step", 0, 1, 9e3, 8e3, "N/m", 9.0)
    assert " or " not in describe_drift(FollowedDrift(change, is_doubtful=False), runs)


def fit_hidden(rig: HiddenRig, seed: int) -> FittedRun:
    record = rig.run(tracking(8.0, seed)).record
    fitted = fit_record(Record(name=record.name, **record.columns()), PlantSettings())
    return replace(fitted, when_s=100.0 * seed)


def test_a_valve_that_begins_to_stick_is_noticed_behind_noise():
    """The pressure's misfit is about three times its noise; no number moves enough to be said."""
    healthy, sticking = (hidden_rig(e, seed=803) for e in ({}, {"valve_hysteresis": 3.0}))
    assert healthy.sensors.pressure_noise_pa == 600.0
    before, again, after = (fit_hidden(r, k) for k, r in enumerate((healthy, healthy, sticking)))
    assert find_changes([before, again]) == []
    grown = {change.name: change.after for change in find_changes([before, after])}
    assert {*grown} == {"pressure" + MISFIT, "position" + MISFIT}
    assert 1.3 < grown["pressure" + MISFIT] < 4.0


@pytest.mark.long
def test_a_folder_of_logs_names_the_number_that_moved(tmp_path):
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    for k, friction in enumerate([55.3, 55.3, 50.0]):
        changed = f"plant.parameters.kinetic_friction_per_m={friction}"
        path = logs / f"2026110{k + 1}-120000-r.mcap"
        done = run_pamctl(
            "run", "--fast", "--quiet", "--experiment", "tracking-2", "--duration", "8",
            "--seed", str(k), "--set", changed, "--log", str(path),
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    (logs / "broken.mcap").write_bytes(b"nothing")
    done = run_pamctl("health", str(logs), "--out", str(out), "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    (drift,) = document["drifts"]
    assert drift["name"] == "kinetic_friction_per_m"
    assert drift["to"] == "20261103-120000-r.mcap"
    assert drift["after"] == pytest.approx(50.0, rel=0.02)
    assert document["last_good"] == ["20261103-120000-r.mcap"]
    plant = read_section_file("plant", out / "plant.yaml")
    assert plant.parameters.kinetic_friction_per_m == pytest.approx(50.0, rel=0.02)
    assert "<svg" in (out / "report.html").read_text()


def test_a_folder_without_runs_is_refused(tmp_path):
    done = run_pamctl("health", str(tmp_path), "--out", str(tmp_path / "out"))
    assert done.returncode == 65
    assert "two are needed" in done.stderr
    assert not (tmp_path / "out").exists()


def test_runs_of_one_moment_stand_side_by_side_and_later_ones_on_an_axis_of_their_size():
    axes = {}
    for apart_s in (0.007, 600.0, 86_400.0, 30 * 86_400.0):
        runs = [SimpleNamespace(when_s=1e9 + k * apart_s) for k in range(3)]
        places, axis = _place_runs(runs)  # type: ignore[arg-type]
        axes[apart_s] = axis.title
        assert np.ptp(places) >= 1.0
    assert [*axes.values()] == [
        "run", "since the first run, min", "since the first run, h", "since the first run, d"
    ]  # fmt: skip
