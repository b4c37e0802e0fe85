"""`pamctl manual` lists the pages and prints one; other tests check their content."""

from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.manual import list_pages, read_page


def test_the_manual_without_a_page_lists_every_page_below_its_kind():
    done = CliRunner().invoke(app, ["manual"])
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    for page in list_pages():
        assert f"{page.kind}:" in lines
        assert any(line.split() == [page.name, *page.title.split()] for line in lines)


def test_in_a_pipe_a_page_is_plain_markdown():
    name = list_pages()[0].name
    done = CliRunner().invoke(app, ["manual", name])
    assert done.exit_code == 0
    assert done.stdout.rstrip() == read_page(name).rstrip()


def test_an_unknown_page_exits_with_2_and_the_nearest_name():
    name = list_pages()[0].name
    done = CliRunner().invoke(app, ["manual", name + "x"])
    assert done.exit_code == 2
    assert name in done.stderr
    assert not done.stdout
