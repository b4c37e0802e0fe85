"""What a terminal is shown: any name of a file, no control characters, and what a wait is for."""

import io
import json
import os
import pty
import re
import shutil
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.command_line import run_pamctl
from support.small_log import write_small

from pamctl.base.texts import PlainStream, clean_document, clean_lines, clean_text, escape_name
from pamctl.log import read
from pamctl.session.simulated_rig import simulate

# --- names and characters ------------------------------------------------------------------------

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


def test_runs_lists_logs_whose_names_are_no_text(folder):
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


def test_verbs_that_write_a_name_into_a_file_escape_it(folder):
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
def test_a_name_is_escaped_only_where_it_cannot_be_shown(name, shown):
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
def test_the_help_of_every_verb_is_shown_where_the_terminal_lacks_characters():
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [sys.executable, "-c", _HELP_OF_ALL], env=environment, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    text = done.stdout.decode("ascii")
    assert text.count("--help") > 40
    assert "?" in text


def test_a_result_is_printed_where_the_terminal_lacks_characters(tmp_path):
    log = shutil.copy(GOLDEN / "qsmc.mcap", tmp_path / "\u4e2d.mcap")
    done = subprocess.run(
        [sys.executable, "-m", "pamctl", "log", "check", str(log)],
        env={**os.environ, "PYTHONIOENCODING": "latin-1"},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()


def test_help_is_shown_where_there_is_no_locale_and_keeps_its_brackets():
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "COLUMNS": "120"}
    done = subprocess.run(
        [sys.executable, "-m", "pamctl", "log", "import", "--help"],
        env={**os.environ, **plain}, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    assert b"`Position [mm]`" in done.stdout


# --- control characters from outside reach no terminal, no page and no log -----------------------

HOSTILE = (
    "a\x1b[2J\x1b[1;1H\x1b]0;title\x07\x1bc\x9b31m\u202egnol\u2066\u200b\x00\x7f\r\nb\u2028c\ud800"
)


def is_harmless(text: str) -> bool:
    """No control (Cc) but tab and line feed, no override of direction, no half of a character."""
    kinds = {unicodedata.category(one) for one in text if one not in "\t\n"}
    turns = {unicodedata.bidirectional(one) for one in text}
    overrides = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
    return not kinds & {"Cc", "Cs", "Zl", "Zp"} and not turns & overrides


@settings(max_examples=20)
@given(st.text() | st.text(alphabet="\x1b\x9b\x9d[]0;m\x07\\P\n\r\u202eab", max_size=20))
@example(HOSTILE)
@example("\x1b\x1b[[2J")
def test_a_cleaned_text_steers_nothing_and_stays_as_it_is(text):
    assert is_harmless(clean_lines(text))
    assert is_harmless(clean_text(text))
    assert not set(clean_text(text)) & set("\t\n")
    assert clean_lines(clean_lines(text)) == clean_lines(text)
    assert "\x1b" not in json.dumps(clean_document({text: [text]}), ensure_ascii=False)


LETTERS = "Ä µm 15 °C, 東 e\u0301, نص عربي, שלום, 👩\u200d🔬"


@pytest.mark.parametrize(
    ("dirty", "clean"),
    [
        (LETTERS, LETTERS),
        (HOSTILE, "agnol b c"),
        ("a\x1b[31;1mred\x1b[0m", "ared"),
        ("\x9b2Jx\x1b(B\x1bc", "x"),
        ("\x1b]8;;http://x\x1b\\link\x1b]8;;\x07", "link"),
        ("two\nlines\tand\u2028more", "two lines and more"),
        ("half \udc80 \x00\x7f\x85end", "half   end"),
    ],
)  # fmt: skip
def test_letters_of_any_script_stay_and_sequences_vanish_as_a_whole(dirty, clean):
    assert clean_text(dirty) == clean
    assert clean_lines(f"{LETTERS}\t{clean}\n") == f"{LETTERS}\t{clean}\n"


def test_a_progress_line_may_begin_anew_but_not_in_its_middle():
    paper = io.StringIO()
    stream = PlainStream(paper)
    stream.write("\rabc\rd\x1b[2K")
    assert paper.getvalue() == "\rabcd"


def test_a_mark_blanks_no_terminal_and_is_logged_without_its_controls(tmp_path):
    with simulate(logs=tmp_path, overrides=["rig.homing.enabled=false"]) as rig:
        rig.goto(8e-3, within_s=0.5)
        rig.mark(HOSTILE)
        status = rig.status()
    shown = [event["text"] for event in status["events"] if "text" in event]
    logged = [event["text"] for event in read(status["log"]).events if event["event"] == "mark"]
    assert shown == logged == ["agnol b c"]


def test_an_old_log_that_holds_them_shows_none(tmp_path):
    log = write_small(tmp_path / "old.mcap", remark=HOSTILE.rstrip("\ud800"))
    assert b"\\u001b[2J" in log.read_bytes() or b"\x1b[2J" in log.read_bytes()
    page = tmp_path / "page.html"
    told = [_pamctl("log", "info", str(log)), _pamctl("report", str(log), "--out", str(page))]
    assert all(is_harmless(text) for text in [*told, page.read_text(encoding="utf-8")])
    assert "agnol" in page.read_text(encoding="utf-8")


def _pamctl(*arguments: str) -> str:
    done = run_pamctl(*arguments)
    assert is_harmless(done.stdout + done.stderr)
    return done.stdout


# --- a verb that is silent for seconds says what it does, on a terminal only ---------------------

SLOW = """
import time, sys
from pamctl.cli import failure, verbs
verbs.SLOW_VERBS["doze"] = "doze: dozing"
def doze():
    time.sleep(1.5)
    print("done")
failure.print_plainly(doze, "doze")()
"""


def test_a_silent_verb_says_what_it_does_until_it_prints():
    ours, its = pty.openpty()
    done = subprocess.run([sys.executable, "-c", SLOW], stdout=its, stderr=its, timeout=60)
    assert done.returncode == 0
    seen = os.read(ours, 65536).decode()
    os.close(ours)
    os.close(its)
    assert re.fullmatch(r"(\r\x1b\[Kdoze: dozing, \d+ s)+\r\x1b\[Kdone\r\n", seen)


def test_without_a_terminal_nothing_is_shown():
    done = subprocess.run([sys.executable, "-c", SLOW], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("done\n", "")
