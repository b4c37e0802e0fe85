"""Measured tables in README and manual are written by the scripts that measured them."""

from __future__ import annotations

from pathlib import Path

import measured_table
import pytest
from measured_table import describe_measurement, find_page, format_table, write_between


def test_only_the_text_between_the_comments_changes(tmp_path: Path) -> None:
    page = tmp_path / "README.md"
    page.write_text("a\n<!-- begin t -->\nold\n<!-- end t -->\nb | c\n")
    write_between("t", format_table(["x", "y"], [["1", "a|b"]]), page)
    assert page.read_text() == (
        "a\n<!-- begin t -->\n| x | y |\n| --- | --- |\n| 1 | a\\|b |\n<!-- end t -->\nb | c\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<!-- begin t -->",
        "<!-- end t --><!-- begin t -->",
        "<!-- begin t -->" * 2 + "<!-- end t -->",
    ],
)
def test_a_page_without_both_comments_is_left_alone(tmp_path: Path, text: str) -> None:
    page = tmp_path / "README.md"
    page.write_text(text)
    with pytest.raises(ValueError, match="<!-- begin t -->"):
        write_between("t", "new", page)
    assert page.read_text() == text


def test_a_row_that_is_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match="differs in length"):
        format_table(["a", "b"], [["1"]])


def test_a_table_is_found_in_the_manual_too(tmp_path: Path) -> None:
    page = tmp_path / "pamctl" / "manual" / "reference" / "tracking.md"
    page.parent.mkdir(parents=True)
    page.write_text("<!-- begin t -->\n<!-- end t -->\n")
    (tmp_path / "README.md").write_text("no table here\n")
    assert find_page("t", tmp_path) == page
    (tmp_path / "README.md").write_text("<!-- begin t -->\n")
    with pytest.raises(ValueError, match="2 pages"):
        find_page("t", tmp_path)


def test_a_table_says_how_it_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measured_table.sys, "argv", ["/anywhere/tracking_table.py", "--write"])
    assert "`python scripts/tracking_table.py --write`" in describe_measurement()


@pytest.mark.parametrize(
    ("name", "words"),
    [("tracking_table", ("`qsmc`", "`smc`", "`pid`")), ("interval_coverage", ("intervals",))],
)
def test_each_measured_table_has_one_place(name: str, words: tuple[str, ...]) -> None:
    page = find_page(name).read_text(encoding="utf-8")
    between = page.split(f"<!-- begin {name} -->")[1].split(f"<!-- end {name} -->")[0]
    assert all(word in between for word in words)
