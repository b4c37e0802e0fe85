"""Names of files that are no UTF-8, and terminals that lack characters, end no verb."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.command_line import run_pamctl

from pamctl.log import read
from pamctl.plain_text import escape_name

GOLDEN = Path(__file__).parents[1] / "golden"
LATIN = os.fsdecode(b"caf\xe9.mcap")
"""As a Windows share or an old stick leaves it."""
BROKEN = "line\nbreak.mcap"
RIGHT_TO_LEFT = "\u202egpj.mcap"
SHOWN = {"caf\\xe9.mcap", "line\\nbreak.mcap", "\\u202egpj.mcap", "good.mcap"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (LATIN, BROKEN, RIGHT_TO_LEFT, "good.mcap"):
        shutil.copy(GOLDEN / "qsmc.mcap", tmp_path / name)
    return tmp_path


def test_runs_lists_logs_whose_names_are_no_text(folder: Path) -> None:
    for _ in range(2):  # from the logs, and from the index
        done = run_pamctl("runs", "--logs", folder, "--json")
        assert done.returncode == 0, done.stderr
        found = {run["path"]: run["ending"] for run in json.loads(done.stdout)["runs"]}
        assert found == dict.fromkeys(SHOWN, "ok")
    for form in ((), ("--csv",), ("--paths",)):
        done = run_pamctl("runs", "--logs", folder, *form)
        assert done.returncode == 0, done.stderr
        assert all(name in done.stdout for name in SHOWN)
        assert len(done.stdout.splitlines()) <= len(SHOWN) + 3
    (folder / LATIN).unlink()
    done = run_pamctl("runs", "--logs", folder, "--paths")
    assert done.stdout.count("\n") == len(SHOWN) - 1


def test_a_damaged_log_with_such_a_name_is_listed_too(folder: Path) -> None:
    (folder / LATIN).write_bytes(b"nothing of the kind")
    (folder / BROKEN).write_bytes(b"")
    done = run_pamctl("runs", "--logs", folder, "--json")
    assert {run["path"] for run in json.loads(done.stdout)["runs"]} == SHOWN


def test_verbs_that_write_a_name_into_a_file_escape_it(folder: Path) -> None:
    measured = folder / os.fsdecode(b"m\xe9s.csv")
    rows = (f"{0.01 * n:.2f},{n % 2},{200 + n % 7},{n % 11}" for n in range(120))
    measured.write_text("\n".join(["t_s,valve_v,pressure_kpa,position_mm", *rows]))
    log, plant = folder / LATIN, folder / os.fsdecode(b"pl\xe9.yaml")
    shutil.copy(Path(__file__).parents[2] / "config" / "plant" / "paper.yaml", plant)
    ran = folder / "ran.mcap"
    for words in (
        ["log", "recover", log, folder / os.fsdecode(b"r\xe9c.mcap")],
        ["log", "cut", log, "--from-s", "0.1", "--out", folder / os.fsdecode(b"c\xfft.mcap")],
        ["log", "import", measured, folder / os.fsdecode(b"i\xe9.mcap")],
        ["log", "export", log, folder / os.fsdecode(b"e\xe9.csv")],
        ["log", "export", log, folder / "e.parquet"],
        ["log", "export", log, folder / "e.mat"],
        ["runs", "tag", "good", log],
        ["runs", "note", "a note", log],
        ["run", "--fast", "--duration", "0.01", "--plant", plant, "--log", ran],
    ):
        done = run_pamctl(*words)
        assert done.returncode == 0, (words, done.stdout, done.stderr)
    assert read(folder / os.fsdecode(b"i\xe9.mcap")).metadata["import"]["source"] == "m\\xe9s.csv"
    assert read(ran).metadata["run"]["plant"].endswith("pl\\xe9.yaml")


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("a b.mcap", "a b.mcap"),
        ("\u00e9\u4e2d\u200d.mcap", "\u00e9\u4e2d\u200d.mcap"),
        ("\u00a0\t\x1b[2J\u2028", "\u00a0\\t\\x1b[2J\\u2028"),
        ("\ud800", "\\ud800"),
    ],
)
def test_a_name_is_escaped_only_where_it_cannot_be_shown(name: str, shown: str) -> None:
    assert escape_name(name) == shown
    assert escape_name(name).encode()


_HELP_OF_ALL = """
import sys
from typer.main import get_command
from pamctl.__main__ import main
from pamctl.cli.app import app

def walk(command, words):
    yield words
    for name, inner in getattr(command, "commands", {}).items():
        yield from walk(inner, [*words, name])

for words in walk(get_command(app), []):
    sys.argv = ["pamctl", *words, "--help"]
    try:
        main()
    except SystemExit as leaving:
        assert not leaving.code, words
    except Exception:
        print(words, file=sys.stderr)
        raise
"""


@pytest.mark.long
def test_the_help_of_every_verb_is_shown_where_the_terminal_lacks_characters() -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [sys.executable, "-c", _HELP_OF_ALL], env=environment, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    text = done.stdout.decode("ascii")
    assert text.count("--help") > 40
    assert "?" in text


def test_a_result_is_printed_where_the_terminal_lacks_characters(tmp_path: Path) -> None:
    log = shutil.copy(GOLDEN / "qsmc.mcap", tmp_path / "\u4e2d.mcap")
    done = subprocess.run(
        [sys.executable, "-m", "pamctl", "log", "check", str(log)],
        env={**os.environ, "PYTHONIOENCODING": "latin-1"},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()


def test_help_is_shown_where_there_is_no_locale_and_keeps_its_brackets() -> None:
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "COLUMNS": "120"}
    done = subprocess.run(
        [sys.executable, "-m", "pamctl", "log", "import", "--help"],
        env={**os.environ, **plain}, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    assert b"`Position [mm]`" in done.stdout
