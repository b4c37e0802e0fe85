"""Control characters from outside reach no terminal, no page and no log."""

from __future__ import annotations

import io
import json
import unicodedata
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.command_line import run_pamctl
from support.small_log import write_small

from pamctl.log import read
from pamctl.plain_text import PlainStream, clean_document, clean_lines, clean_text
from pamctl.session.simulated_rig import simulate

HOSTILE = (
    "a\x1b[2J\x1b[1;1H\x1b]0;title\x07\x1bc\x9b31m\u202egnol\u2066\u200b\x00\x7f\r\nb\u2028c\ud800"
)


def is_harmless(text: str) -> bool:
    """No control (Cc) but tab and line feed, no override of direction, no half of a character."""
    kinds = {unicodedata.category(one) for one in text if one not in "\t\n"}
    turns = {unicodedata.bidirectional(one) for one in text}
    overrides = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
    return not kinds & {"Cc", "Cs", "Zl", "Zp"} and not turns & overrides


@given(st.text() | st.text(alphabet="\x1b\x9b\x9d[]0;m\x07\\P\n\r\u202eab", max_size=20))
@example(HOSTILE)
@example("\x1b\x1b[[2J")
def test_a_cleaned_text_steers_nothing_and_stays_as_it_is(text: str) -> None:
    assert is_harmless(clean_lines(text))
    assert is_harmless(clean_text(text))
    assert not set(clean_text(text)) & set("\t\n")
    assert clean_lines(clean_lines(text)) == clean_lines(text)
    assert "\x1b" not in json.dumps(clean_document({text: [text]}), ensure_ascii=False)


@pytest.mark.parametrize(
    "text", ["Ä µm 15 °C", "نص عربي", "日本語", "שלום", "👩\u200d🔬 measured", "a\tb\nc"]
)
def test_letters_of_any_script_stay(text: str) -> None:
    assert clean_lines(text) == text


def test_sequences_vanish_as_a_whole() -> None:
    assert clean_text(HOSTILE) == "agnol b c"


def test_a_progress_line_may_begin_anew_but_not_in_its_middle() -> None:
    paper = io.StringIO()
    stream = PlainStream(paper)
    stream.write("\rabc\rd\x1b[2K")
    assert paper.getvalue() == "\rabcd"


def test_a_mark_blanks_no_terminal_and_is_logged_without_its_controls(tmp_path: Path) -> None:
    with simulate(logs=tmp_path, overrides=["rig.homing.enabled=false"]) as rig:
        rig.goto(8e-3, within_s=0.5)
        rig.mark(HOSTILE)
        status = rig.status()
    shown = [event["text"] for event in status["events"] if "text" in event]
    logged = [event["text"] for event in read(status["log"]).events if event["event"] == "mark"]
    assert shown == logged == ["agnol b c"]


def test_an_old_log_that_holds_them_shows_none(tmp_path: Path) -> None:
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
