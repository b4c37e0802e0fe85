"""Measured tables in README and manual are written by the scripts that measured them."""

import pytest
from measured_table import find_page, format_table, write_between


def test_only_the_text_between_the_comments_changes(tmp_path):
    page = tmp_path / "README.md"
    page.write_text("a\n<!-- begin t -->\nold\n<!-- end t -->\nb | c\n")
    write_between("t", format_table(["x", "y"], [["1", "a|b"]]), page)
    assert page.read_text() == (
        "a\n<!-- begin t -->\n| x | y |\n| --- | --- |\n| 1 | a\\|b |\n<!-- end t -->\nb | c\n"
    )


@pytest.mark.parametrize(
    ("name", "words"),
    [("tracking_table", ("`qsmc`", "`smc`", "`pid`")), ("interval_coverage", ("intervals",))],
)
def test_each_measured_table_has_one_place(name, words):
    page = find_page(name).read_text(encoding="utf-8")
    between = page.split(f"<!-- begin {name} -->")[1].split(f"<!-- end {name} -->")[0]
    assert all(word in between for word in words)
