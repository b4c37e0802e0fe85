"""`pamctl log cut`: a piece of a log says of what it is a piece, and works like a log."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run_pamctl
from typer.testing import CliRunner

import pamctl.log
from pamctl.cli.app import app
from pamctl.diagnose.record import record_of
from pamctl.log.importing.pipeline import write_imported


def pamctl_(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of a closed-loop run of 6 s after homing."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    run_pamctl("run", "--fast", "--duration", "3", "--quiet", "--log", path).check_returncode()
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


def test_a_piece_by_time_holds_the_same_ticks_and_says_where_they_come_from(
    run: Path, tmp_path: Path
) -> None:
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


def test_a_piece_replays_from_its_first_frozen_state_and_says_so(run: Path, tmp_path: Path) -> None:
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


def test_a_piece_of_a_piece_keeps_the_whole_story(run: Path, tmp_path: Path) -> None:
    pamctl_("log", "cut", run, "--out", tmp_path / "one.mcap", "--from-row", "3000")
    pamctl_("log", "cut", tmp_path / "one.mcap", "--out", tmp_path / "two.mcap", "--from-row", "9")
    two = pamctl.log.read(tmp_path / "two.mcap")
    assert two["tick"][0] == pamctl.log.read(run)["tick"][3009]
    assert json.loads(two.metadata["cut"]["source_cut"])["source"] == "run.mcap"
    assert pamctl_("replay", tmp_path / "two.mcap").exit_code == 0
    assert pamctl_("compare", tmp_path / "two.mcap").exit_code == 0


def test_at_gaps_every_stretch_becomes_a_file(paused: Path, tmp_path: Path) -> None:
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


def test_what_cannot_be_cut_is_one_error_and_leaves_nothing(paused: Path, tmp_path: Path) -> None:
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
