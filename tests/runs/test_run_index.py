"""`pamctl runs`: the index of a folder's logs, and the words that filter it."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from support.small_log import write_small
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.log import read
from pamctl.log.edit import append_metadata, read_annotation, write_annotation
from pamctl.log.run_meta import make_annotation
from pamctl.offline.merit import compute_log_merits
from pamctl.runs.run_index import (
    INDEX_NAME,
    FilterError,
    RunFilter,
    RunIndex,
    RunsError,
    append_rows,
    edit_annotations,
    read_date,
    select_runs,
)
from pamctl.runs.run_row import RunRow, read_row

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with two logs, half a log, an imported one, and three files that are none."""
    logs = tmp_path / "logs"
    logs.mkdir()
    for name in ("qsmc", "pid-delayed"):
        shutil.copy(GOLDEN / f"{name}.mcap", logs)
    (logs / "half.mcap").write_bytes((GOLDEN / "qsmc.mcap").read_bytes()[:100_000])
    write_small(logs / "imported.mcap")
    (logs / "text.mcap").write_text("nothing of the kind")
    (logs / "empty.mcap").touch()
    (logs / "notes.txt").write_text("not looked at")
    (logs / "link.mcap").symlink_to(GOLDEN / "qsmc.mcap")
    (logs / "folder.mcap").mkdir()
    os.mkfifo(logs / "pipe.mcap")
    return logs


def rows_of(folder: Path) -> dict[str, RunRow]:
    index = RunIndex(folder)
    index.refresh()
    return {row.path: row for row in index.select()}


def test_every_log_has_a_row_whatever_its_state(folder):
    rows = rows_of(folder)
    assert {name: row.ending for name, row in rows.items()} == {
        "qsmc.mcap": "ok",
        "pid-delayed.mcap": "ok",
        "half.mcap": "unfinished",
        "imported.mcap": "imported",
        "text.mcap": "unreadable",
        "empty.mcap": "unreadable",
    }
    assert 0 < rows["half.mcap"].ticks < rows["qsmc.mcap"].ticks
    assert rows["text.mcap"].reason
    assert rows["pid-delayed.mcap"].law == "pid"


@pytest.mark.parametrize("name", ["qsmc", "pid-delayed"])
def test_the_figures_are_those_of_the_run_itself(name):
    row, log = read_row(GOLDEN / f"{name}.mcap"), read(GOLDEN / f"{name}.mcap")
    merit = compute_log_merits(log.columns)["measured"]
    assert merit is not None
    assert (row.max_um, row.rms_um) == pytest.approx((1e6 * merit.max_m, 1e6 * merit.rms_m))
    assert row.ticks == len(log)
    assert row.missed == int(log["missed"].sum())
    assert row.gains["controller.law"] == log.config["controller"]["law"] == row.law


def test_the_index_is_made_again_from_the_logs_alone(folder):
    first = rows_of(folder)
    index = folder / INDEX_NAME
    index.unlink()
    assert rows_of(folder) == first
    whole = index.read_bytes()
    index.write_bytes(whole[: len(whole) // 2] + bytes(5000))  # damaged
    assert rows_of(folder) == first
    index.write_text("something else altogether, longer than the head of a database file " * 3)
    assert rows_of(folder) == first
    index.unlink()
    index.mkdir()  # none can be made: it is kept in memory
    assert rows_of(folder) == first


def test_an_index_of_another_version_is_made_again(folder):
    first = rows_of(folder)
    index = folder / INDEX_NAME
    index.write_text(index.read_text().replace('"format": 3', '"format": 99'))
    assert rows_of(folder) == first


def test_an_index_that_was_added_to_often_is_written_anew(folder):
    rows = rows_of(folder)
    for _ in range(100):
        append_rows(folder, rows.values())
    grown = (folder / INDEX_NAME).stat().st_size
    assert rows_of(folder) == rows
    assert (folder / INDEX_NAME).stat().st_size < grown / 50


def test_new_changed_moved_and_removed_logs_are_seen(folder):
    rows_of(folder)
    (folder / "qsmc.mcap").rename(folder / "moved.mcap")
    (folder / "pid-delayed.mcap").unlink()
    write_annotation(folder / "imported.mcap", make_annotation(["good"]))
    rows = rows_of(folder)
    assert rows.keys() == {"moved.mcap", "half.mcap", "imported.mcap", "text.mcap", "empty.mcap"}
    assert rows["imported.mcap"].tags == ("good",)


def test_only_what_is_new_is_read(folder):
    rows_of(folder)
    shutil.copy(GOLDEN / "missed.mcap", folder)
    said = []
    RunIndex(folder).refresh(lambda done, of: said.append((done, of)))
    assert said == [(1, 1)]


A_USER = """
import os, sys
from pathlib import Path
from pamctl.runs.run_index import edit_annotations
from pamctl.runs.run_index import RunIndex

folder = Path(sys.argv[1])
for n in range(3):
    RunIndex(folder).refresh(rebuild=n % 2)
    edit_annotations([folder / "imported.mcap"], lambda said: said.add_tag(f"p{os.getpid()}n{n}"))
"""


def test_processes_may_use_the_index_at_once(folder):
    users = [
        subprocess.Popen([sys.executable, "-c", A_USER, str(folder)], stderr=subprocess.PIPE)
        for _ in range(3)
    ]
    for user in users:
        _, complaint = user.communicate(timeout=120)
        assert user.returncode == 0, complaint.decode()
    expected = {f"p{user.pid}n{n}" for user in users for n in range(3)}
    assert set(read_annotation(folder / "imported.mcap").tags) == expected
    assert set(rows_of(folder)["imported.mcap"].tags) == expected


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(RunsError, match="no folder"):
        RunIndex(tmp_path / "nowhere")


def test_all_logs_are_looked_at_before_one_is_changed(folder):
    good = folder / "imported.mcap"
    before = good.read_bytes()
    done = CliRunner().invoke(app, ["runs", "tag", "x", str(good), str(folder / "text.mcap")])
    assert done.exit_code == 65
    assert good.read_bytes() == before
    edit_annotations([good, good], lambda said: said.add_tag("x"))
    changed = good.read_bytes()
    edit_annotations([good], lambda said: said.add_tag("x"))
    assert good.read_bytes() == changed


def invoke(*words: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_runs_are_tagged_noted_found_and_listed(folder):
    there = ("runs", "--logs", folder)
    qsmc, pid = folder / "qsmc.mcap", folder / "pid-delayed.mcap"
    invoke("runs", "tag", "good", qsmc, pid)
    invoke("runs", "untag", "good", pid)
    invoke("runs", "note", "new \x1b[31mhose", qsmc)
    assert invoke(*there, "--tag", "good", "--paths") == f"{qsmc}\n"
    assert invoke(*there, "--where", "note=*HOSE*", "--paths") == f"{qsmc}\n"
    ended_well = ("--where", "ending=ok")
    assert invoke(*there, "--where", "law=p*", *ended_well, "--paths") == f"{pid}\n"
    table = invoke(*there, *ended_well)
    assert "[good]  new hose" in table
    assert table.startswith("2 of 6 runs\n")
    (one,) = json.loads(invoke(*there, "--tag", "good", "--json"))["runs"]
    assert one["path"] == "qsmc.mcap"
    assert one["note"] == "new hose"
    csv = invoke(*there, *ended_well, "--csv").splitlines()
    assert len(csv) == 3
    assert "controller.law" in csv[0].split(",")


def test_a_hostile_log_writes_no_control_character_to_the_terminal(folder):
    log = folder / "imported.mcap"
    append_metadata(log, "run", {"law": "\x1b[31mlaw", "experiment": "a\u202eb\nc"})
    shown = invoke("runs", "--logs", folder)
    assert not {c for c in shown if not c.isprintable()} - {"\n"}


# --- filters -------------------------------------------------------------------------------------

DAY_S = 86400.0
ROWS = [
    RunRow(
        f"{n:03}.mcap", 1, n,
        when_s=n * DAY_S,
        law=("qsmc", "smc", "pid")[n % 3],
        plant="paper" if n % 2 else "Leaky[1]",
        ending=("ok", "trip", "unfinished")[n % 5 % 3],
        exit_code=(0, 4, None)[n % 5 % 3],
        max_um=None if n % 7 == 0 else float(n),
        tags=("good",) * (n % 2) + ("old", "good2")[: n % 3],
        note=f"hose {n % 4} % _",
        marks="load on" if n % 10 == 0 else "",
        gains={"controller.lambda_per_s": float(n % 4), "controller.law": "x", "seed": n},
    )
    for n in range(60)
]  # fmt: skip


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> RunIndex:
    index = RunIndex(tmp_path_factory.mktemp("filter"))
    index.put(ROWS)
    return index


def names(index: RunIndex, **wanted: Any) -> list[str]:
    return [row.path for row in select_runs(index, RunFilter(**wanted))]


def expected(holds: Callable[[RunRow], bool]) -> list[str]:
    return [row.path for row in ROWS if holds(row)]


def test_rows_come_back_as_they_were_put(index):
    assert index.select() == ROWS


@pytest.mark.parametrize(
    ("wanted", "holds"),
    [
        ({}, lambda r: True),
        ({"where": ["law=SMC"]}, lambda r: r.law == "smc"),
        ({"where": ["law = *smc"]}, lambda r: r.law.endswith("smc")),
        ({"where": ["law!=*smc"]}, lambda r: not r.law.endswith("smc")),
        ({"where": ["plant=leaky[1]"]}, lambda r: r.plant == "Leaky[1]"),
        ({"where": ["ending=trip"]}, lambda r: r.ending == "trip"),
        ({"where": ["exit_code=4"]}, lambda r: r.exit_code == 4),
        ({"tags": ["good"]}, lambda r: "good" in r.tags),
        ({"tags": ["good", "old"]}, lambda r: {"good", "old"} <= set(r.tags)),
        ({"where": ["note=*HOSE 2 %*"]}, lambda r: "hose 2 %" in r.note),
        ({"where": ["marks=*load*"]}, lambda r: r.marks != ""),
        ({"where": ["max_um>=10", "max_um<=20"]}, lambda r: r.max_um and 10 <= r.max_um <= 20),
        ({"where": ["controller.lambda_per_s=2"]}, lambda r: r.gains["seed"] % 4 == 2),
        ({"where": ["controller.law=x"]}, lambda r: True),
        ({"where": ["seed >= 30"]}, lambda r: r.gains["seed"] >= 30),
        ({"where": ["max_um<5"]}, lambda r: r.max_um and r.max_um < 5),
        ({"since_s": 9 * DAY_S}, lambda r: r.when_s >= 9 * DAY_S),
    ],
)
def test_a_condition_selects_what_it_says(index, wanted, holds):
    found = expected(lambda row: bool(holds(row)))
    assert found
    assert names(index, **wanted) == found
    assert names(index, **wanted, last=2) == found[-2:]


@pytest.mark.parametrize(
    "wanted",
    [
        {"where": ["max_um>x"]},
        {"where": ["ending=well"]},
        {"where": ["law>pid"]},
        {"where": ["controller.lambda_per_s"]},
        {"where": ["controller.lambda_per_s>fast"]},
        {"where": ["controller.lamda_per_s>1"]},
        {"where": ["max_um>'; DROP TABLE runs; --"]},
    ],
)
def test_a_condition_that_makes_no_sense_is_refused(index, wanted):
    with pytest.raises(FilterError):
        names(index, **wanted)


def test_an_unknown_setting_is_named_with_the_nearest(index):
    with pytest.raises(FilterError, match=r"did you mean controller\.lambda_per_s\?"):
        names(index, where=["controller.lamda_per_s>1"])


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("2026-11-01", datetime(2026, 11, 1)),
        ("2026-11-01 14:30", datetime(2026, 11, 1, 14, 30)),
        ("2026-11-01T14:30:05", datetime(2026, 11, 1, 14, 30, 5)),
    ],
)
def test_a_date_is_that_of_this_pc(text, meant):
    assert read_date(text) == meant.timestamp()


def test_a_date_with_a_zone_is_that_instant():
    assert read_date("2026-11-01T14:30+00:00") == 1793543400.0


@pytest.mark.parametrize("text", ["", "monday", "2026-13-01", "25:00", "9" * 400])
def test_a_date_that_makes_no_sense_is_refused(text):
    with pytest.raises(FilterError, match="write 2026-11-20"):
        read_date(text)
