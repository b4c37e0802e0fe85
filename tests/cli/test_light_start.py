"""Verbs that a user types all day start at once: they import no more than they need."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support.command_line import run_process
from support.small_log import write_small
from typer.testing import CliRunner

from pamctl.cli.app import build_app, build_asked

HEAVY = {"asyncio", "google", "mcap", "multiprocessing", "numba", "numpy", "pydantic", "rich",
         "scipy", "yaml"}  # fmt: skip
SHOW_IMPORTS = """
import sys
from pamctl.__main__ import main
sys.argv = ["pamctl", *sys.argv[1:]]
try:
    main()
finally:
    print("imported:", *{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)
"""


def list_heavy_imports(*arguments: str) -> set[str]:
    done = run_process([sys.executable, "-c", SHOW_IMPORTS, *arguments])
    assert "Traceback" not in done.stderr
    return HEAVY & set(done.stderr.rpartition("imported:")[2].split())


@pytest.mark.parametrize("arguments", [["--help"], ["nosuch"], ["diagnose", "--help"]])
def test_help_and_advice_import_no_verb(arguments: list[str]) -> None:
    assert list_heavy_imports(*arguments) <= {"rich"}


@pytest.mark.parametrize("verb", ["status", "estop"])
def test_a_verb_of_the_daemon_imports_no_model_and_no_algebra(verb: str, tmp_path: Path) -> None:
    assert list_heavy_imports(verb, "--socket", str(tmp_path / "none.sock")) == set()


def test_a_look_into_a_log_imports_no_settings(tmp_path: Path) -> None:
    log = write_small(tmp_path / "small.mcap")
    assert list_heavy_imports("log", "info", str(log)) == {"google", "mcap", "numpy"}


def test_the_help_of_the_whole_says_what_each_verb_says_of_itself() -> None:
    wide = {"COLUMNS": "200"}
    by_name = CliRunner().invoke(build_asked(["--help"]), ["--help"], env=wide)
    in_full = CliRunner().invoke(build_app(), ["--help"], env=wide)
    assert by_name.output == in_full.output
    assert "Move the muscle" in by_name.output


def test_a_verb_after_the_end_of_options_is_carried_out() -> None:
    done = run_process([sys.executable, "-m", "pamctl", "--", "manual"])
    assert done.returncode == 0
    assert "first-run" in done.stdout
