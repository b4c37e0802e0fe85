"""Reports: one page for any log, which a browser shows without errors."""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.chromium import look, printed
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.log import read
from pamctl.log.importing.pipeline import write_imported
from pamctl.log.reader import read_some
from pamctl.report.html_page import write_html
from pamctl.report.reported_run import REPORT_FIELDS, name_runs
from pamctl.report.run_page import compose_report

HOSTILE = "<script>alert('x')</script>"


def run_to(path: Path, *options: str) -> Path:
    """A real simulated run in a separate process."""
    command = ["run", "--fast", "--quiet", "--log", str(path), *options]
    result = CliRunner().invoke(app, command)
    assert path.exists(), result.output
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def minute(folder: Path) -> Path:
    """Experiment 1 with the paper's qSMC: more than 60 s."""
    return run_to(
        folder / "minute.mcap", "--experiment", "tracking-1", "--controller", "paper-table3-qsmc"
    )


@pytest.fixture(scope="module")
def tripped(folder: Path) -> Path:
    return run_to(folder / "tripped.mcap", "--controller", "paper-table3-smc")


@pytest.fixture(scope="module")
def square(folder: Path) -> Path:
    return run_to(folder / "square.mcap", "--experiment", "square-2", "--duration", "2")


@pytest.fixture(scope="module")
def imported(folder: Path) -> Path:
    t_s = np.arange(3000) * 1e-3
    write_imported(
        folder / "imported.mcap", t_s, {"pressure_pa": 2e5 + 1e4 * np.sin(t_s)}, {"source": HOSTILE}
    )
    return folder / "imported.mcap"


@cache
def page_of(*paths: Path) -> str:
    return write_html(compose_report([read(path) for path in paths]))


@pytest.mark.long
def test_the_columns_that_a_report_reads_are_all_that_it_shows(minute, tripped, imported):
    for path in (minute, tripped, imported):
        assert write_html(compose_report([read_some(path, REPORT_FIELDS)])) == page_of(path)


def test_the_page_of_a_minute_stays_below_a_megabyte_and_holds_the_whole_story(minute):
    html = page_of(minute)
    assert len(html.encode()) < 1_000_000
    for heading in ("Summary", "Motion", "Law", "Timing", "Safety", "Events"):
        assert f">{heading}</h2>" in html
    assert "paper&#x27;s qSMC on its rig, tracking-1" in html
    assert "lambda_per_s: 10.0" in html


def test_the_figures_of_the_page_are_those_of_the_run(minute):
    log = read(minute)
    counted = np.isin(log["phase"], (2, 3))
    error_um = (log["position_m"] - log["reference_m"])[counted] * 1e6
    html = page_of(minute)
    assert f"{np.abs(error_um).max():.1f}</td>" in html
    assert f"{np.sqrt(np.mean(error_um**2)):.1f}</td>" in html


def test_a_trip_is_shown_with_its_reason_and_its_time(tripped):
    html = page_of(tripped)
    assert "Ended with exit code 4" in html
    at_s = read(tripped)["t_s"][-1] - read(tripped)["t_s"][name_runs([read(tripped)])[0].shown][0]
    assert re.search(rf"trip</td>.*tracking error above its limit.*{at_s:.3f}", html)


def test_an_open_loop_log_has_no_law_and_says_that_nothing_was_tracked(square):
    html = page_of(square)
    assert "Nothing was tracked" in html
    assert ">Law</h2>" not in html
    assert ">Displacement <" in html


def test_an_imported_log_shows_its_signals_and_its_source_is_escaped(imported):
    html = page_of(imported)
    assert ">Pressure <" in html
    assert ">Displacement <" not in html
    assert "<script" not in html
    assert "&lt;script&gt;" in html
    assert "the time between samples: 1 to 1 ms, usually 1." in html


def test_a_log_without_ticks_and_one_with_a_single_tick_are_reported_in_words(folder, imported):
    log = read(imported)
    for count in (0, 1):
        columns = {name: values[:count] for name, values in log.columns.items()}
        short = type(log)(**{**vars(log), "columns": columns, "time_ns": log.time_ns[:count]})
        html = write_html(compose_report([short]))
        words = "holds no tick" if count == 0 else "Too few ticks"
        assert words in html


def test_several_runs_share_a_page_a_time_axis_and_a_table_of_what_differs(minute, tripped, square):
    html = page_of(minute, tripped, square)
    assert "3 runs side by side" in html
    assert re.search(r"<td>controller.lambda_per_s</td>.*?10.*?225", html)
    assert html.count(">Displacement <") == 3  # three experiments, three time axes


def test_changed_gains_are_named_in_the_summary(square):
    log = read(square)
    later = {**log.gains[0], "lambda_per_s": 12.5, "tick": 3000}
    html = write_html(compose_report([type(log)(**{**vars(log), "gains": [log.gains[0], later]})]))
    assert f"lambda_per_s {log.gains[0]['lambda_per_s']:g} to 12.5" in html


def test_a_run_that_never_tracked_does_not_hide_one_that_did(tripped, folder):
    good = run_to(folder / "good.mcap", "--duration", "9")
    assert read(tripped).config["experiment"] == read(good).config["experiment"]
    html = page_of(good, tripped)
    assert "axis cuts the error" in html
    assert "axis cuts the error" not in page_of(tripped)


def test_logs_of_the_same_name_are_distinguished_by_their_folders(folder, square):
    twin = folder / "elsewhere"
    twin.mkdir()
    (twin / square.name).write_bytes(square.read_bytes())
    names = [run.name for run in name_runs([read(square), read(twin / square.name)])]
    assert names == ["square", "elsewhere/square"]


def test_a_damaged_log_is_refused_with_the_way_out(folder, square):
    broken = folder / "broken.mcap"
    broken.write_bytes(square.read_bytes()[:-4000])
    result = CliRunner().invoke(app, ["report", str(broken)])
    assert result.exit_code == 65
    assert "pamctl log recover" in result.output
    assert not broken.with_suffix(".html").exists()


def test_the_command_names_the_page_and_its_size(folder, square):
    target = folder / "the page.html"
    result = CliRunner().invoke(app, ["report", str(square), "--out", str(target), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert found["page"] == str(target)
    assert found["bytes"] == target.stat().st_size


@pytest.mark.long
@pytest.mark.parametrize("which", ["tripped", "imported"])
def test_a_phone_shows_the_page_without_errors_and_without_scrolling_sideways(
    which, request, tmp_path
):
    page = tmp_path / "report.html"
    page.write_text(page_of(request.getfixturevalue(which)))
    found, console, asked = look(page, tmp_path, width=390)
    assert console == []
    assert asked == [page.as_uri()]
    assert found["outside"] == []
    assert found["needed"] <= found["width"] <= 390
    assert found["plots"] > 0
    assert found["smallest"] >= 11.0  # px: a plot's words keep their size


def test_the_page_prints_with_its_folded_texts(minute, tmp_path):
    page = tmp_path / "report.html"
    page.write_text(page_of(minute))
    document = printed(page, tmp_path)
    assert document.startswith(b"%PDF")
    pages = len(re.findall(rb"/Type\s*/Page\b", document))
    assert 4 <= pages <= 20


def find_plots(html: str) -> dict[str, str]:
    """The plots of a page by their titles."""
    parts = html.split('<div class="ptitle">')[1:]
    return {part.split(" <span", 1)[0]: part for part in parts}


def test_every_plot_over_time_has_the_same_axis_and_marks_each_moment(minute):
    log = read(minute)
    mark = {"event": "mark", "tick": int(log["tick"][20_000]), "text": "touched the hose"}
    later = {**log.gains[0], "lambda_per_s": 12.5, "tick": int(log["tick"][30_000])}
    marked = {"events": [*log.events, mark], "gains": [log.gains[0], later]}
    plots = find_plots(write_html(compose_report([type(log)(**{**vars(log), **marked})])))
    over_time = ("Displacement", "Tracking error", "Pressure", "Command", "Terms of the command")
    ticks = {
        title: re.findall(r'<text class="xt[^"]*" x="([^"]+)" y="\d+">([^<]+)<', plots[title])
        for title in over_time
    }
    assert len({tuple(found) for found in ticks.values()}) == 1
    for title in over_time:
        assert ">touched the hose</text>" in plots[title]
        assert ">gains</text>" in plots[title]
