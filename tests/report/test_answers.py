"""An answer is printed the same everywhere: its numbers, its tables, its progress."""

from __future__ import annotations

import time

import pytest

from pamctl.report.html_page import write_html
from pamctl.report.progress_line import WorkProgress
from pamctl.report.report import Facts, Points, Report, ReportTable, Section, Text, format_terminal


def test_terminal_and_page_say_the_same_and_the_terminal_in_ascii() -> None:
    report = Report("Title", "12.3 µm ± 0.1: good").add(
        Section("Errors"),
        ReportTable(["", "max, µm"], [["measured", "38.5"], ["true", "-"]], "All of it."),
        Facts({"plant": "paper"}),
        Points(["run `pamctl doctor`"]),
        Text("\N{MINUS SIGN}3 V"),
    )
    said = format_terminal(report)
    assert said.isascii()
    assert said.splitlines() == [
        "12.3 um +- 0.1: good", "", "Errors", "All of it.", "          max, um",
        "measured     38.5", "true            -", "", "plant  paper", "", "- run pamctl doctor",
        "-3 V",
    ]  # fmt: skip
    page = write_html(report)
    for part in (
        "12.3 µm ± 0.1: good",
        "38.5</td>",
        "<dd>paper</dd>",
        "<code>pamctl doctor</code>",
    ):
        assert part in page


def test_long_work_says_in_a_file_how_far_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    with WorkProgress("compare") as show:
        show(1, 4, "paper, mechanics")
        assert "25%" in show.line()
        assert "left" in show.line()
        assert capsys.readouterr().err == ""
        deadline_s = time.monotonic() + 30.0
        while not (said := capsys.readouterr().err) and time.monotonic() < deadline_s:
            time.sleep(0.1)
    # It may say, too, that the model is compiled: that depends on what ran before.
    assert said.startswith("compare: paper, mechanics")
    assert ", 2 s, 25%, about " in said
