"""The comparison of a model with a measurement finds the block that differs."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.command_line import parse_command
from support.free_mass import axis, pushed_mass
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.log import LogError, read, signals
from pamctl.log.importing.pipeline import write_imported
from pamctl.models.comparison import compare_model
from pamctl.models.comparison_report import report_comparison
from pamctl.plant.drive import drive_coupled, drive_mechanics, drive_pressure
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import parameters_of, rest_state
from pamctl.report.report import Figure, ReportTable, format_terminal
from pamctl.settings.resolve import settings_to_yaml

GOLDEN = Path(__file__).parents[1] / "golden"
PAPER = parameters_of({})
PERIOD_S = 1e-3
COUNT_M = 3.175e-6
NOISE_PA = 300.0


def command(ticks: int = 4000) -> NDArray[np.float64]:
    """Fill, exhaust and hold: every side of the valve, and every motion."""
    t_s = np.arange(ticks) * PERIOD_S
    return np.where(np.floor(t_s / 0.4) % 4 == 3, 0.0, 1.2 * np.sin(2 * np.pi * 0.9 * t_s) + 0.15)


def measured(
    path: Path,
    changes: dict[str, float],
    *leave_out: str,
    command_v: NDArray[np.float64] | None = None,
) -> Path:
    """Simulate a measurement of another lab, on a plant that differs from the paper's."""
    valve_v = command() if command_v is None else command_v
    driven = drive_coupled(parameters_of(changes), valve_v, PERIOD_S)
    noise = np.random.default_rng(1).normal(0.0, NOISE_PA, len(valve_v))
    columns = {
        "valve_v": valve_v,
        "pressure_pa": driven.pressure_pa + noise,
        "position_m": np.round(driven.position_m / COUNT_M) * COUNT_M,
    }
    for name in leave_out:
        del columns[name]
    write_imported(path, np.arange(len(valve_v)) * PERIOD_S, columns, {})
    return path


def test_ticks_at_which_a_sensor_is_frozen_count_in_no_gap(tmp_path):
    whole = measured(tmp_path / "whole.mcap", {})
    log = signals(read(whole))
    pressure_pa = np.array(log.pressure_pa)
    pressure_pa[1500:1900] = pressure_pa[1500]
    columns = {"valve_v": log.valve_v, "pressure_pa": pressure_pa, "position_m": log.position_m}
    write_imported(tmp_path / "frozen.mcap", log.t_s, columns, {})
    found = compare_model(read(tmp_path / "frozen.mcap"), PAPER)
    assert found.frozen is not None
    assert np.flatnonzero(found.frozen).tolist() == list(range(1500, 1900))
    assert found.gap(found.coupled, "pressure_pa").max < 5.0 * NOISE_PA


def test_the_model_begins_again_after_a_pause_of_the_record(tmp_path):
    whole = signals(read(measured(tmp_path / "whole.mcap", {})))
    kept = np.ones(len(whole), bool)
    kept[1250:1650] = False  # the pressure falls meanwhile, by another command than the last one
    columns = {n: getattr(whole, n)[kept] for n in ("valve_v", "pressure_pa", "position_m")}
    write_imported(tmp_path / "pause.mcap", whole.t_s[kept], columns, {})
    log = read(tmp_path / "pause.mcap")
    found = compare_model(log, PAPER)
    assert found.pauses == 1
    for way in (found.coupled, found.pressure_block):
        assert found.gap(way, "pressure_pa").rms == pytest.approx(NOISE_PA, rel=0.2)
    assert found.coupled.pressure_pa is not None
    assert np.flatnonzero(np.isnan(found.coupled.pressure_pa)).tolist() == [*range(1250, 1500)]
    said = format_terminal(report_comparison(log, {"": found}))
    assert "begins again after a pause of the record" in said


# --- a model that is right ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "rms_counts"), [("qsmc", 1.5), ("smc", 1.5), ("steps", 1.5), ("pid-delayed", 3.5)]
)
def test_a_simulated_run_agrees_with_its_own_plant_within_its_sensors(name, rms_counts):
    log = read(GOLDEN / f"{name}.mcap")
    plant = plant_parameters(PlantSettings.model_validate(log.config["plant"]))
    found = compare_model(log, plant)
    assert found.gap(found.coupled, "position_m").rms < rms_counts * COUNT_M
    for way in (found.coupled, found.pressure_block):
        assert found.gap(way, "pressure_pa").rms == pytest.approx(311.0, rel=0.15)
    assert found.measured.t_s[0] > 0.3  # homing is left out


@pytest.mark.parametrize(
    ("name", "rms_pa", "at_once_pa"),
    [
        ("missed", 330.0, 500.0),  # the simulation in real time, with 300 Pa of noise
        ("card", 20.0, 45.0),  # on demand
        ("card-clocked", 80.0, 800.0),  # puts out at its next edge, also at one that is missed
    ],
)
def test_a_real_time_log_agrees_with_its_own_plant_for_commands_act_when_the_log_says(
    name, rms_pa, at_once_pa
):
    log = read(GOLDEN / f"{name}.mcap")
    assert log["missed"].sum() > 30
    plant = plant_parameters(PlantSettings.model_validate(log.config["plant"]))
    found = compare_model(log, plant)
    assert found.gap(found.coupled, "position_m").rms < 3.0 * COUNT_M
    assert found.gap(found.pressure_block, "pressure_pa").rms < rms_pa
    part = found.measured
    assert part.valve_v is not None
    assert part.pressure_pa is not None
    assert part.position_m is not None
    at_once = drive_pressure(plant, part.valve_v, part.position_m, part.dt_s[1:])
    assert np.sqrt(np.mean((at_once.pressure_pa - part.pressure_pa) ** 2)) > at_once_pa


def test_a_gap_is_drawn_as_model_minus_measurement():
    log = read(GOLDEN / "qsmc.mcap")
    found = compare_model(log, PAPER)
    report = report_comparison(log, {"paper": found}, is_drawn=True)
    plots = {p.title: p for part in report.parts if isinstance(part, Figure) for p in part.plots}
    for title, factor, model, seen in (
        ("Mechanics alone", 1e6, found.mechanics.position_m, found.measured.position_m),
        (
            "Pressure block alone",
            1e-3,
            found.pressure_block.pressure_pa,
            found.measured.pressure_pa,
        ),
    ):
        (line,) = plots[title].marks
        assert line.ys[0] == pytest.approx(factor * (model - seen), nan_ok=True)
    assert [mark.label for mark in plots["Displacement"].marks] == ["measured", "paper"]


# --- a model that is wrong -----------------------------------------------------------------------


def test_a_wrong_stiffness_is_seen_in_the_mechanics_and_not_in_the_pressure_block(tmp_path):
    found = compare_model(read(measured(tmp_path / "a.mcap", {"stiffness_n_per_m": 9000.0})), PAPER)
    assert found.gap(found.mechanics, "position_m").rms > 20 * COUNT_M
    assert found.gap(found.pressure_block, "pressure_pa").rms == pytest.approx(NOISE_PA, rel=0.05)


def test_a_wrong_valve_gain_is_seen_in_the_pressure_block_and_not_in_the_mechanics(tmp_path):
    right = compare_model(read(measured(tmp_path / "a.mcap", {})), PAPER)
    wrong = compare_model(
        read(measured(tmp_path / "b.mcap", {"valve_gain_m2_per_v": 1.2e-6})), PAPER
    )
    assert wrong.gap(wrong.pressure_block, "pressure_pa").rms > 10 * NOISE_PA
    floor = right.gap(right.mechanics, "position_m").rms
    assert wrong.gap(wrong.mechanics, "position_m").rms == pytest.approx(floor, rel=0.3)


# --- what a log holds, and what it does not ------------------------------------------------------


def test_without_a_command_the_mechanics_alone_can_be_compared(tmp_path):
    found = compare_model(read(measured(tmp_path / "a.mcap", {}, "valve_v")), PAPER)
    assert found.coupled.position_m is found.pressure_block.pressure_pa is None
    assert found.gap(found.mechanics, "position_m").rms < 5 * COUNT_M
    assert np.isnan(found.gap(found.coupled, "pressure_pa").rms)


def test_one_signal_alone_is_refused(tmp_path):
    path = measured(tmp_path / "a.mcap", {}, "position_m", "pressure_pa")
    with pytest.raises(LogError, match="holds valve_v only"):
        compare_model(read(path), PAPER)
    done = CliRunner().invoke(app, ["compare", str(path), "--json"])
    assert done.exit_code == 65
    assert json.loads(done.stdout)["exit_code"] == 65


def test_values_that_are_not_numbers_are_skipped_and_the_model_restarts_after_them(tmp_path):
    path = measured(tmp_path / "a.mcap", {})
    log = read(path)
    broken = {name: column.copy() for name, column in signals_of(path).items()}
    broken["pressure_pa"][1000:1100] = np.nan
    write_imported(tmp_path / "b.mcap", log.t, broken, {})
    found = compare_model(read(tmp_path / "b.mcap"), PAPER)
    assert np.isnan(found.coupled.position_m[1000:1100]).all()
    assert np.isfinite(np.delete(found.coupled.position_m, slice(1000, 1100))).all()
    assert found.gap(found.coupled, "pressure_pa").rms < 3 * NOISE_PA


def signals_of(path: Path) -> dict[str, NDArray[np.float64]]:
    here = signals(read(path))
    return {name: getattr(here, name) for name in ("valve_v", "pressure_pa", "position_m")}


def test_a_recovered_log_is_compared_on_both_sides_of_what_it_lost(tmp_path):
    log = read(GOLDEN / "qsmc.mcap")
    keep = np.ones(len(log), bool)
    keep[600:700] = False
    holed = type(log)(
        **{
            **{field: getattr(log, field) for field in log.__dataclass_fields__},
            "columns": {name: column[keep] for name, column in log.columns.items()},
            "time_ns": log.time_ns[keep],
        }
    )
    found = compare_model(holed, PAPER)
    assert found.gap(found.coupled, "position_m").rms < 5 * COUNT_M
    left_out = np.flatnonzero(np.isnan(found.coupled.position_m))  # the 0.25 s after it
    assert len(left_out) * 0.002 == pytest.approx(0.25)
    assert len(left_out) == np.ptp(left_out) + 1


# --- the verb ------------------------------------------------------------------------------------


def test_two_models_appear_side_by_side_with_the_next_step(tmp_path):
    log = GOLDEN / "pid-delayed.mcap"
    page = tmp_path / "compare.html"
    arguments = ["compare", str(log), "--plant", "paper", "--plant", "paper-valve109"]
    done = CliRunner().invoke(app, [*arguments, "--plot", str(page)])
    assert done.exit_code == 0, done.stderr
    assert "paper-valve109" in done.stdout
    advised = done.stdout.rsplit("next: ", 1)[1]
    # The closest of them is the one to go on with, in whatever order they are given.
    assert advised.startswith(f"pamctl diagnose {log} --plant paper-valve109 --out diagnosis")
    parse_command(advised)
    html = page.read_text()
    assert html.count("<figure") == 2
    assert ">Displacement, model \N{MINUS SIGN} measurement <" in html
    numbers = re.findall(r'<td class="num">([^<]*)</td>', html)
    for row in done.stdout.splitlines():
        if row.startswith("paper"):
            shown = re.findall(r"(?<= )(?:[\d.]+|-)(?= |$)", row)
            assert set(shown) <= set(numbers), row
    assert "paper-valve109" in html
    document = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    gaps = {p["plant"]: p["gap"]["pressure_block"]["pressure_pa"] for p in document["plants"]}
    assert gaps["paper-valve109"]["rms"] < gaps["paper"]["rms"]
    assert document["plants"][0]["gap"]["mechanics"]["pressure_pa"] == {"rms": None, "max": None}


def test_a_chamber_has_one_way_to_be_driven_and_is_shown_once(tmp_path):
    still = {"actuator": "chamber", "chamber_volume_m3": 2e-3}
    plant = plant_parameters(PlantSettings.model_validate(still))
    log = read(measured(tmp_path / "a.mcap", {}, "position_m"))
    report = report_comparison(log, {"c": compare_model(log, plant, "chamber")}, is_drawn=True)
    (table,) = [part for part in report.parts if isinstance(part, ReportTable)]
    assert [row[:2] for row in table.rows] == [["c", "coupled"]]
    plots = [p.title for part in report.parts if isinstance(part, Figure) for p in part.plots]
    assert plots == [
        "Pressure, absolute",
        "Pressure, absolute, model \N{MINUS SIGN} measurement",
        "Valve command",
    ]


def test_a_plant_that_does_not_exist_is_refused_with_the_nearest():
    done = CliRunner().invoke(app, ["compare", str(GOLDEN / "qsmc.mcap"), "--plant", "papr"])
    assert done.exit_code == 2
    assert "did you mean 'paper'" in done.stderr


def test_a_page_that_cannot_be_written_is_refused_before_anything_is_computed(tmp_path):
    page = tmp_path / "nowhere" / "page.html"
    done = CliRunner().invoke(app, ["compare", str(tmp_path / "no.mcap"), "--plot", str(page)])
    assert done.exit_code == 2
    assert "there is no directory" in done.stderr


def test_an_axis_that_forgets_nothing_is_compared_in_windows_and_has_no_coupled_figures(tmp_path):
    record = pushed_mass(1)
    assert record.force_n is not None
    assert record.position_m is not None
    columns = {"force_n": record.force_n, "position_m": record.position_m}
    write_imported(tmp_path / "axis.mcap", record.t_s, columns, {})
    (tmp_path / "mine.yaml").write_text(settings_to_yaml(axis(1.1)))
    page = tmp_path / "page.html"
    asked = ["compare", str(tmp_path / "axis.mcap"), "--plant", str(tmp_path / "mine.yaml")]
    done = CliRunner().invoke(app, [*asked, "--plot", str(page)])
    assert done.exit_code == 0, done.output
    assert "begins again every 0.256 s" in done.stdout
    assert "coupled" not in done.stdout
    assert "coupled" not in page.read_text().split("</style>")[1]
    (row,) = [line for line in done.stdout.splitlines() if "mechanics" in line]
    rms_um = float(row.split()[-2])
    assert rms_um < 0.2 * compare_free(tmp_path / "axis.mcap", axis(1.1))


def compare_free(path: Path, plant: PlantSettings) -> float:
    """The gap in micrometres of a mechanism that runs freely from the first sample on."""
    here = signals(read(path))
    assert here.position_m is not None
    found = drive_mechanics(
        plant_parameters(plant),
        np.full(len(here), 101_325.0),
        here.dt_s[1:],
        force_n=here.force_n,
        start=rest_state(plant_parameters(plant), float(here.position_m[0]), 101_325.0),
    )
    return float(1e6 * np.sqrt(np.mean((found.position_m - here.position_m) ** 2)))
