"""`pamctl log cut` and `export`: pieces of a log, and its columns for other programs."""

import builtins
import csv
import json
import math
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat
from support.command_line import run_pamctl
from support.made_up import log_run
from typer.testing import CliRunner

import pamctl.log
from pamctl.cli.app import app
from pamctl.diagnose.read_record import record_of
from pamctl.log.export import export_ticks
from pamctl.log.importing.pipeline import import_log, write_imported
from pamctl.log.schema import unit_of_column
from pamctl.signals import Phase


def pamctl_(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of a closed-loop run of 6 s after homing."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    changes = ("--set", "rig.loop.stop_ramp_s=1.5")  # a frozen state within the stop
    run_pamctl("run", "--fast", "--duration", "3", *changes, "--quiet", "--log", path)
    return path


@pytest.fixture
def paused(tmp_path: Path) -> Path:
    """Return an imported log of 300 rows at 100 Hz, with pauses before rows 100 and 101."""
    steps = np.full(299, 0.01)
    steps[[99, 100]] = 0.4
    t_s = np.concatenate([[0.0], np.cumsum(steps)])
    columns = {"force_n": np.sin(t_s), "position_m": 1e-2 * np.cos(t_s)}
    write_imported(tmp_path / "paused.mcap", t_s, columns, {"source": "paused.csv"})
    return tmp_path / "paused.mcap"


def test_a_piece_by_time_holds_the_same_ticks_and_says_where_they_come_from(run, tmp_path):
    piece = tmp_path / "piece.mcap"
    done = pamctl_("log", "cut", run, "--out", piece, "--from-s", "2.5", "--to-s", "4.25", "--json")
    assert done.exit_code == 0
    whole, part = pamctl.log.read(run), pamctl.log.read(piece)
    there = (whole.t >= 2.5) & (whole.t < 4.25)
    assert len(part) == there.sum() > 1700
    for name in part.columns:
        assert np.array_equal(part[name], whole[name][there], equal_nan=True), name
    cut = part.metadata["cut"]
    first = int(np.argmax(there))
    assert (cut["source"], cut["source_rows"]) == ("run.mcap", str(len(whole)))
    assert (cut["first_row"], cut["last_row"]) == (str(first), str(first + len(part) - 1))
    assert cut["sha256"] == sha256(run.read_bytes()).hexdigest()
    assert json.loads(done.stdout)["pieces"][0]["first_row"] == first
    assert part.config == whole.config
    assert all(
        part["tick"][0] <= e["tick"] <= part["tick"][-1] for e in (*part.events, *part.keyframes)
    )
    assert "cut from        run.mcap" in pamctl_("log", "info", piece).stdout
    checked = pamctl_("log", "check", piece)
    assert (checked.exit_code, "warning" in checked.stdout) == (0, False)


def test_a_piece_replays_from_its_first_frozen_state_and_says_so(run, tmp_path):
    whole = pamctl.log.read(run)
    states = [keyframe["tick"] for keyframe in whole.keyframes]
    late, right_after = tmp_path / "late.mcap", tmp_path / "right-after.mcap"
    pamctl_("log", "cut", run, "--out", late, "--from-row", states[2] + 301)
    said = pamctl_("replay", late)
    assert said.exit_code == 0, said.stdout
    assert "its first 700 ticks have no frozen state before them" in said.stdout
    assert "not compared" not in said.stdout  # the program's references are computed again
    pamctl_("log", "cut", run, "--out", right_after, "--from-row", states[2] + 1)
    said = pamctl_("replay", right_after)
    assert said.exit_code == 0, said.stdout
    ticks = len(whole) - states[2] - 1
    assert f"equal, {ticks} ticks" in said.stdout
    assert "with the frozen state before them" in said.stdout
    short = tmp_path / "short.mcap"
    start = states[2] + 10
    pamctl_("log", "cut", run, "--out", short, "--from-row", start, "--to-row", start + 500)
    said = pamctl_("replay", short)
    assert said.exit_code == 65
    assert "holds no frozen state" in said.stderr


def test_of_a_piece_that_begins_within_the_stop_all_but_the_ramp_is_compared(run, tmp_path):
    whole = pamctl.log.read(run)
    stop = int(np.argmax(whole["phase"] == Phase.STOPPING))
    state = next(k["tick"] for k in whole.keyframes if k["tick"] > stop)
    pamctl_("log", "cut", run, "--out", tmp_path / "end.mcap", "--from-row", state + 1)
    said = pamctl_("replay", tmp_path / "end.mcap")
    ticks = len(whole) - state - 1
    assert f"{ticks} of {ticks} ticks were replayed and do not differ" in said.stdout
    assert f"reference not compared in {ticks} ticks" in said.stdout


def test_a_piece_of_a_piece_keeps_the_whole_story(run, tmp_path):
    pamctl_("log", "cut", run, "--out", tmp_path / "one.mcap", "--from-row", "3000")
    pamctl_("log", "cut", tmp_path / "one.mcap", "--out", tmp_path / "two.mcap", "--from-row", "9")
    two = pamctl.log.read(tmp_path / "two.mcap")
    assert two["tick"][0] == pamctl.log.read(run)["tick"][3009]
    assert json.loads(two.metadata["cut"]["source_cut"])["source"] == "run.mcap"
    assert pamctl_("replay", tmp_path / "two.mcap").exit_code == 0
    assert pamctl_("compare", tmp_path / "two.mcap").exit_code == 0


def test_at_gaps_every_stretch_becomes_a_file(paused, tmp_path):
    done = pamctl_("log", "cut", paused, "--out", tmp_path / "part.mcap", "--at-gaps")
    assert "left out, alone between two gaps: row 100" in done.stdout
    lengths = [len(record_of(tmp_path / f"part-{number}.mcap")) for number in (1, 2)]
    assert lengths == [100, 199]
    assert not (tmp_path / "part-3.mcap").exists()
    for number in (1, 2):
        checked = pamctl_("log", "check", tmp_path / f"part-{number}.mcap").stdout
        assert "error" not in checked
        assert "warning" not in checked
        assert "of 300" in checked


def test_what_cannot_be_cut_is_one_error_and_leaves_nothing(paused, tmp_path):
    new = tmp_path / "new.mcap"
    for options, code, words in (
        (["--from-s", "99"], 2, "it has rows 0 to 299, from 0 to 3.77 s"),
        (["--from-row", "20", "--to-row", "20"], 2, "it has rows 0 to 299"),
        ([], 2, "say what to cut"),
    ):
        done = pamctl_("log", "cut", paused, "--out", new, *options)
        assert (done.exit_code, new.exists()) == (code, False)
        assert words in done.stderr
    (tmp_path / "lab.csv").write_text("t_s,position_m\n0,1\n")
    done = pamctl_("log", "cut", tmp_path / "lab.csv", "--out", new, "--at-gaps")
    assert done.exit_code == 65
    assert "import it first" in done.stderr
    done = pamctl_("log", "cut", paused, "--out", paused, "--from-row", "3")
    assert done.exit_code == 2
    assert "never overwritten" in done.stderr


# --- export --------------------------------------------------------------------------------------

TICKS = 300


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> pamctl.log.Log:
    directory = tmp_path_factory.mktemp("log")
    return pamctl.log.read(log_run(directory / "a.ring", directory / "run.mcap", TICKS))


def pamctl_export(log: pamctl.log.Log, out: Path, *options: str) -> Any:
    return CliRunner().invoke(app, ["log", "export", str(log.path), str(out), *options])


def from_csv(path: Path) -> dict[str, list[Any]]:
    with path.open(newline="") as file:
        names, *rows = csv.reader(file)
    return dict(
        zip(names, ([float(x) for x in column] for column in zip(*rows, strict=True)), strict=True)
    )


def from_mat(path: Path) -> dict[str, list[Any]]:
    content = loadmat(path, simplify_cells=True)
    assert content["units"] == {name: unit_of_column(name) for name in content["log"]}
    return {name: column.tolist() for name, column in content["log"].items()}


def from_parquet(path: Path) -> dict[str, list[Any]]:
    from pyarrow import parquet

    table = parquet.read_table(path)
    for field in table.schema:
        assert field.metadata[b"unit"].decode() == unit_of_column(field.name)
    return dict(table.to_pydict())


FORMATS = {"csv": from_csv, "mat": from_mat, "parquet": from_parquet}


@pytest.mark.parametrize(("suffix", "read_back"), FORMATS.items(), ids=FORMATS)
def test_every_column_comes_back_to_the_bit(log, tmp_path, suffix, read_back):
    done = pamctl_export(log, tmp_path / f"a.{suffix}")
    assert done.exit_code == 0, done.output
    back = read_back(tmp_path / f"a.{suffix}")
    assert list(back) == list(log.columns)
    for name, column in log.columns.items():
        assert back[name] == column.tolist(), name


@pytest.mark.parametrize(("suffix", "read_back"), FORMATS.items(), ids=FORMATS)
def test_a_part_is_chosen_by_fields_time_and_stride(log, tmp_path, suffix, read_back):
    out = tmp_path / f"a.{suffix}"
    chosen = ("--fields", "position_m,t_s", "--from", "0.05", "--to", "0.1", "--every", "10")
    assert pamctl_export(log, out, *chosen).exit_code == 0
    back = read_back(out)
    assert list(back) == ["position_m", "t_s"]
    assert back["position_m"] == log["position_m"][50:101:10].tolist()


def test_numbers_that_are_not_finite_survive_a_csv(tmp_path):
    from pamctl.log.importing.pipeline import write_imported

    values = np.array([math.nan, math.inf, -math.inf, -0.0, 5e-324])
    write_imported(tmp_path / "a.mcap", np.arange(5.0), {"force_n": values}, {})
    export_ticks(tmp_path / "a.mcap", tmp_path / "a.csv")
    assert list(map(repr, from_csv(tmp_path / "a.csv")["force_n"])) == list(
        map(repr, values.tolist())
    )


@pytest.mark.parametrize("suffix", ["csv", "mat"])
def test_what_was_exported_can_be_imported(log, tmp_path, suffix):
    out = tmp_path / f"a.{suffix}"
    pamctl_export(log, out, "--fields", "t_s,position_m")
    done = import_log(out, tmp_path / "b.mcap", accept_units=True)
    assert done.written, done.findings
    back = pamctl.log.read(tmp_path / "b.mcap")
    assert back["position_m"].tolist() == log["position_m"].tolist()


@pytest.mark.parametrize(
    ("out", "options", "code", "told"),
    [
        ("a.xls", (), 2, "no such format '.xls'"),
        ("a.csv", ("--from", "9"), 2, "no ticks to export there; the log is from 0 s to 0.299 s"),
        ("a.csv", ("--fields", "position_mm"), 2, "did you mean position_m?"),
        ("a.csv", ("--fields", ","), 2, "names no column"),
        ("no/a.csv", (), 2, "there is no directory"),
        ("there.csv", (), 2, "never overwritten"),
    ],
)
def test_what_cannot_be_exported_is_refused_and_leaves_nothing(
    log, tmp_path, out, options, code, told
):
    (tmp_path / "there.csv").write_text("precious")
    done = pamctl_export(log, tmp_path / out, *options)
    assert done.exit_code == code
    assert told in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["there.csv"]
    assert (tmp_path / "there.csv").read_text() == "precious"


def test_parquet_without_its_package_says_what_to_install(log, tmp_path, monkeypatch):
    real = builtins.__import__

    def without_pyarrow(name: str, *rest: Any, **more: Any) -> Any:
        if name.partition(".")[0] == "pyarrow":
            raise ModuleNotFoundError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without_pyarrow)
    done = pamctl_export(log, tmp_path / "a.parquet")
    assert done.exit_code == 2
    assert "pip install pyarrow" in done.stderr
    assert not (tmp_path / "a.parquet").exists()
