"""Sweeps: what is run, what is there already, and what the table says."""

import json
import os
import shutil
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.exit_codes import Ending, ExitCode
from pamctl.log.annotation import SWEEP, Annotation, make_annotation
from pamctl.log.edit import append_metadata, read_annotation, write_annotation
from pamctl.report.report import Figure
from pamctl.runs.run_row import RunRow, read_row
from pamctl.session.run_sweep import (
    SweepError,
    SweepPlan,
    SweepRun,
    find_runs,
    list_runs,
    parse_sweep,
    require_end,
    run_sweep,
)
from pamctl.session.sweep_result import (
    format_points_csv,
    summarise_points,
    tabulate_points,
    write_sweep_page,
)
from pamctl.settings.resolve import resolve

GOLDEN = Path(__file__).parents[1] / "golden" / "qsmc.mcap"
KEY = "controller.lambda_per_s"


def test_a_setting_with_several_values_is_swept():
    request = parse_sweep([f"{KEY}=20,40", "plant.x=[1,2]", "controller.mode=a, b"], 1)
    assert request.fixed == ("plant.x=[1,2]",)
    assert request.list_points() == [
        (f"{KEY}=20", "controller.mode=a"),
        (f"{KEY}=20", "controller.mode=b"),
        (f"{KEY}=40", "controller.mode=a"),
        (f"{KEY}=40", "controller.mode=b"),
    ]
    assert request.list_overrides()[0][0] == "plant.x=[1,2]"


@pytest.mark.parametrize(
    "overrides",
    [[], [f"{KEY}=20"], [f"{KEY}=1,,2"], [f"{KEY}=1,1"], [f"{KEY}=1,2", f"{KEY}=3,4"],
     [f"{KEY}={','.join(map(str, range(20_000)))}"]],
)  # fmt: skip
def test_a_sweep_that_makes_no_sense_is_refused(overrides):
    with pytest.raises(SweepError):
        parse_sweep(overrides, 1)


def test_all_points_come_before_the_first_repeat():
    runs = list_runs([{"a": 1}, {"a": 2}], 2)
    assert [(run.point["a"], run.repeat) for run in runs] == [(1, 0), (2, 0), (1, 1), (2, 1)]


def test_the_base_of_a_sweep_is_all_but_what_is_swept_and_the_seed():
    request = parse_sweep(["a.b=1,2"], 1)
    mark = request.mark_base({"a": {"b": 1, "c": 2}, "seed": 1})
    assert mark == request.mark_base({"seed": 2, "a": {"c": 2, "b": 5}})
    assert mark != request.mark_base({"a": {"b": 1, "c": 3}})


def test_a_run_without_an_end_is_refused(tmp_path):
    hold = tmp_path / "hold.yaml"
    hold.write_text("kind: hold\nposition_mm: 8\ntransition_s: 1\n")
    with pytest.raises(SweepError, match="--duration"):
        require_end(resolve(experiment=str(hold)))
    require_end(resolve(experiment=str(hold), duration_s=1.0))


@dataclass
class CopyingRunner:
    """Makes a run by a copy of a golden log; some fail, and one is interrupted."""

    folder: Path
    fail: Mapping[float, ExitCode] = field(default_factory=dict)
    interrupt_at: int | None = None
    goes_on: bool = True
    made: list[SweepRun] = field(default_factory=list)

    def __call__(self, run: SweepRun, said: Annotation, record: Mapping[str, str]) -> Ending:
        if len(self.made) == self.interrupt_at:
            raise KeyboardInterrupt
        self.made.append(run)
        code = self.fail.get(run.point[KEY], ExitCode.OK)
        if not code:
            path = (
                self.folder
                / f"{record['point'].count('2')}-{len(list(self.folder.iterdir()))}.mcap"
            )
            shutil.copy(GOLDEN, path)
            append_metadata(path, SWEEP, record)
            write_annotation(path, said)
        return Ending(code, "as the test says")


def plan(folder: Path, *gains: float, repeats: int = 2, base: str = "b") -> SweepPlan:
    runs = list_runs([{KEY: gain} for gain in gains], repeats)
    return SweepPlan("trial", base, runs, folder, make_annotation(["mine"], operator="Ann"))


def quiet(_line: str) -> None:
    pass


def test_an_interrupted_sweep_keeps_what_it_has_and_goes_on(tmp_path):
    sweep = plan(tmp_path, 20.0, 40.0)
    first = CopyingRunner(tmp_path, interrupt_at=3)
    end = run_sweep(sweep, first, quiet)
    assert (end.ending.code, len(end.rows), end.left) == (ExitCode.SIGINT, 3, 1)
    assert all(row.tags == ("mine", "trial") and row.operator == "Ann" for row in end.rows)
    second = CopyingRunner(tmp_path)
    end = run_sweep(sweep, second, quiet)
    assert [(run.point[KEY], run.repeat) for run in second.made] == [(40.0, 1)]
    assert (end.ending.code, len(end.rows), end.left) == (ExitCode.OK, 4, 0)
    more = CopyingRunner(tmp_path)
    run_sweep(plan(tmp_path, 20.0, 40.0, 80.0), more, quiet)
    assert [run.point[KEY] for run in more.made] == [80.0, 80.0]


def test_a_sweep_is_not_continued_under_other_settings(tmp_path):
    run_sweep(plan(tmp_path, 20.0, repeats=1), CopyingRunner(tmp_path), quiet)
    other = CopyingRunner(tmp_path)
    with pytest.raises(SweepError, match="another --name"):
        run_sweep(plan(tmp_path, 20.0, base="other"), other, quiet)
    assert not other.made


@pytest.mark.parametrize("goes_on", [True, False])
def test_a_sweep_of_a_real_muscle_ends_with_the_first_failure(tmp_path, goes_on):
    runner = CopyingRunner(tmp_path, fail={20.0: ExitCode.SAFETY_TRIP}, goes_on=goes_on)
    end = run_sweep(plan(tmp_path, 10.0, 20.0, 40.0, repeats=1), runner, quiet)
    assert len(runner.made) == (3 if goes_on else 2)
    assert end.ending.code == (ExitCode.CHECK_FAILED if goes_on else ExitCode.SAFETY_TRIP)
    assert end.left == (1 if goes_on else 2)


def test_of_runs_that_all_failed_the_newest_is_shown(tmp_path):
    sweep = plan(tmp_path, 20.0, repeats=1)
    (run,) = sweep.runs
    point = json.dumps(run.point, separators=(",", ":"))
    record = {"name": sweep.name, "base": sweep.base, "point": point, "repeat": str(run.repeat)}
    for age_s, name in ((60, "trip-wire"), (0, "trip-nan")):
        path = tmp_path / f"{name}.mcap"
        shutil.copy(GOLDEN.with_name(path.name), path)
        os.utime(path, (1e9 - age_s, 1e9 - age_s))
        append_metadata(path, SWEEP, record)
    (found,) = find_runs(sweep, whatever_ending=True).values()
    assert found.path == "trip-nan.mcap"
    assert not find_runs(sweep)


def test_the_table_is_mean_and_deviation_of_the_runs_that_ended_well():
    def row(gain: float, rms_um: float | None, ending: str = "ok") -> RunRow:
        sweep = {"name": "s", "point": {KEY: gain}, "repeat": 0}
        return RunRow("a", 1, 1, ending=ending, rms_um=rms_um, sweep=sweep)

    rows = [row(2.0, 3.0), row(1.0, 9.0), row(2.0, 4.0), row(2.0, 99.0, "trip")]
    points = summarise_points(rows)
    first = points[0]
    assert (first.runs, first.failed) == (2, {"trip": 1})
    assert first.metrics["rms_um"].mean == 3.5
    assert first.metrics["rms_um"].sd == pytest.approx(statistics.stdev([3.0, 4.0]))
    assert points[1].metrics["rms_um"].sd is None
    assert "3.5 ± 0.7" in tabulate_points(points).rows[0]
    head, line, _ = format_points_csv(points).splitlines()
    named = dict(zip(head.split(","), line.split(","), strict=True))
    assert (named[KEY], named["runs"], named["failed"], named["rms_um_high"]) == (
        "2.0", "2", "1", "4.0",
    )  # fmt: skip
    page = write_sweep_page("s", Path("logs"), rows, [KEY])
    ((plot,),) = (part.plots for part in page.parts if isinstance(part, Figure))
    band, line, dots = plot.marks
    assert (line.x.tolist(), line.ys[0].tolist()) == ([1.0, 2.0], [9.0, 3.5])
    assert [side.tolist() for side in band.ys] == [[9.0, 3.0], [9.0, 4.0]]
    assert dots.ys[0].tolist() == [9.0, 3.5]


def sweep_fast(folder: Path, *words: str) -> Any:
    options = ["--fast", "--duration", "0.4", "--set", "rig.homing.enabled=false", "--json"]
    command = ["sweep", "--logs", str(folder), "--name", "trial", "--set", f"{KEY}=20,40"]
    done = CliRunner().invoke(app, [*command, *options, *words])
    return done.exit_code, json.loads(done.stdout)


@pytest.mark.long
def test_a_sweep_without_a_clock_from_the_command_line(tmp_path):
    folder = tmp_path / "logs"
    code, document = sweep_fast(folder, "--note", "hose 2")
    assert (code, document["left"], len(document["points"])) == (0, 0, 2)
    logs = sorted(folder.glob("*.mcap"))
    assert {read_row(log).gains[KEY] for log in logs} == {20.0, 40.0}
    assert all(read_annotation(log) == Annotation(("trial",), "hose 2") for log in logs)
    assert Path(document["page"]).read_text().startswith("<")
    assert len(Path(document["csv"]).read_text().splitlines()) == 3
    logs[0].unlink()
    assert sweep_fast(folder)[1]["left"] == 0
    again = sorted(folder.glob("*.mcap"))
    assert len(again) == 2
    assert logs[1] in again
    code, document = sweep_fast(folder, "--plant", "paper-valve109")
    assert code == 2
    assert "--name" in document["reason"]
    assert sweep_fast(folder, "--set", "controller.eta=-1")[0] == 78
    assert sorted(folder.glob("*.mcap")) == again
