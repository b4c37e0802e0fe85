"""The reproduced paper: its numbers are those of a real run, and its page is readable."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.chromium import look
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.log import read
from pamctl.models.reproduction import PARTS, is_within_bound
from pamctl.offline.merit import TABLE_IV, compute_log_merits


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper") / "new" / "folder"
    result = CliRunner().invoke(app, ["reproduce", "all", "--out", str(folder)])
    assert result.exit_code == 0, result.output
    return folder


@pytest.fixture(scope="module")
def numbers(whole: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((whole / "numbers.json").read_text())
    return found


@pytest.mark.long
def test_the_numbers_are_those_of_a_run_that_starts_at_once(numbers, tmp_path):
    """The real loop, process and log instead of the compiled batch."""
    log = tmp_path / "run.mcap"
    begin_at_once = ["rig.homing.enabled=false", "rig.calibration.sensor_zero_v=0.215"]
    options = [word for key in begin_at_once for word in ("--set", key)]
    which = ["--controller", "paper-table3-qsmc", "--experiment", "tracking-2"]
    CliRunner().invoke(app, ["run", "--fast", "--quiet", "--log", str(log), *which, *options])
    measured = compute_log_merits(read(log).columns)["measured"]
    assert measured is not None
    batch = numbers["fig5"]["qSMC as printed"]
    assert batch["max_m"] == pytest.approx(measured.max_m, rel=1e-12)
    assert batch["rms_m"] == pytest.approx(measured.rms_m, rel=1e-12)


def test_the_printed_qsmc_stays_inside_table_iv_and_in_millimetres_it_does_not(numbers):
    table = numbers["table4"]
    for experiment in ("tracking-1", "tracking-2"):
        found, bound = table["simulated"]["paper"][experiment], table["paper"][experiment]["qsmc"]
        assert is_within_bound(found["qSMC as printed"], bound)
        assert not is_within_bound(found["qSMC as printed, in mm"], bound)


def test_the_printed_smc_trips_and_without_the_limit_it_is_off_by_millimetres(numbers):
    found = numbers["table4"]["simulated"]["paper"]["tracking-1"]
    assert found["SMC as printed"]["tripped_s"] == pytest.approx(2.8, abs=0.3)
    assert found["SMC as printed"]["max_m"] is None
    assert found["SMC as printed, no limit"]["max_m"] > 10e-3


def test_the_values_of_the_paper_appear_as_printed(numbers):
    assert {
        (experiment, law, row["max_m"], row["rms_m"])
        for experiment, laws in numbers["table4"]["paper"].items()
        for law, row in laws.items()
    } == {(row.experiment, row.law, row.merit.max_m, row.merit.rms_m) for row in TABLE_IV}


def test_slow_squares_reach_tank_and_atmospheric_pressure_and_fast_ones_do_not(numbers):
    slow, fast = (numbers["fig3"][f]["paper"] for f in ("0.25", "2"))
    assert slow["pressure_high_pa"] == pytest.approx(441.3e3, rel=1e-6)
    assert slow["position_low_m"] == pytest.approx(0.0, abs=1e-9)
    # At the vented and at the filled end the forces of Eq. 6 balance: b and L_0 say where.
    assert slow["position_high_m"] == pytest.approx(0.02366, abs=2e-5)
    assert fast["position_low_m"] > 1e-3
    assert fast["position_high_m"] < slow["position_high_m"]


@pytest.mark.parametrize("part", PARTS)
def test_each_part_can_be_made_alone(part, tmp_path):
    command = ["reproduce", part, "--out", str(tmp_path), "--json"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert set(json.loads(result.stdout)) == {"schema", "version", "seed", part}
    assert set(json.loads((tmp_path / "numbers.json").read_text())) >= {part}


def test_an_unknown_part_is_refused_and_leaves_nothing_behind(tmp_path):
    result = CliRunner().invoke(app, ["reproduce", "fig6", "--out", str(tmp_path / "x")])
    assert result.exit_code == 2
    assert "table4" in result.output
    assert not (tmp_path / "x").exists()


def test_a_phone_shows_the_whole_paper_below_a_megabyte(whole, tmp_path):
    page = whole / "index.html"
    assert page.stat().st_size < 1_000_000
    found, console, _ = look(page, tmp_path, width=390)
    assert console == []
    assert found["outside"] == []
    assert found["needed"] <= found["width"] <= 390
    assert np.isfinite(found["smallest"])
