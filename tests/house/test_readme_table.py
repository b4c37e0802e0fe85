"""The README's tables are written by the scripts that measured them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from readme_table import table, write_between  # noqa: E402

BEGIN, END = "<!-- begin t -->", "<!-- end t -->"


def test_only_what_stands_between_the_comments_changes(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text("a\n<!-- begin t -->\nold\n<!-- end t -->\nb | c\n")
    text = table(["x", "y"], [["1", "a|b"]])
    assert write_between("t", text, readme)
    assert readme.read_text() == (
        "a\n<!-- begin t -->\n| x | y |\n| --- | --- |\n| 1 | a\\|b |\n<!-- end t -->\nb | c\n"
    )
    assert not write_between("t", text, readme)  # the second time there is nothing to change


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<!-- begin t -->",
        "<!-- end t --><!-- begin t -->",
        "<!-- begin t -->" * 2 + "<!-- end t -->",
    ],
)
def test_a_readme_without_its_comments_is_left_alone(tmp_path, text):
    readme = tmp_path / "README.md"
    readme.write_text(text)
    with pytest.raises(ValueError, match="<!-- begin t -->"):
        write_between("t", "new", readme)
    assert readme.read_text() == text


def test_a_row_that_is_too_short_is_refused():
    with pytest.raises(ValueError, match="differs in length"):
        table(["a", "b"], [["1"]])


def test_the_readme_has_the_comments_of_the_tracking_table():
    readme = (ROOT / "README.md").read_text()
    assert readme.count("<!-- begin tracking_table -->") == 1
    between = readme.split("<!-- begin tracking_table -->")[1].split("<!-- end tracking_table -->")[
        0
    ]
    assert between.count("`qsmc`") == 2


def test_the_readme_has_the_comments_of_the_study():
    readme = (ROOT / "README.md").read_text()
    begin, end = "<!-- begin study_claims -->", "<!-- end study_claims -->"
    assert readme.count(begin) == readme.count(end) == 1
    between = readme.split(begin)[1].split(end)[0]
    assert all(f"`{law}`" in between for law in ("qsmc", "smc", "pid"))
