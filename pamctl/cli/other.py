"""`pamctl reproduce`, the paper's figures and Table IV; `pamctl manual`, the pages to read."""

from __future__ import annotations

import sys
from itertools import groupby
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import Options, argument, option, verb
from pamctl.cli.output import PAGE_BEGIN, print_report
from pamctl.json_text import to_json
from pamctl.new_file import NewFileError, require_folder, require_place, write_files

_ALL = "all"
_NUMBERS_BEGIN = "{"


class ReproduceOptions(Options):
    """`pamctl reproduce`."""

    part: str = argument("fig3|fig4|fig5|table4|all", "Part of the paper")
    out: Path = option("--out DIR", "Folder for the page and the numbers", ...)
    seed: int = option("--seed N", "Seed of the simulated noise", 0, low=0)


@verb
def reproduce(asked: ReproduceOptions) -> None:
    """Write DIR/index.html and DIR/numbers.json; every number is simulated now."""
    from pamctl.report.html_page import write_html
    from pamctl.report.progress_line import WorkProgress
    from pamctl.reproduce.reproduction import PARTS, reproduce_paper

    part, out = asked.part, asked.out
    if part not in (_ALL, *PARTS):
        known = ", ".join((*PARTS, _ALL))
        raise typer.BadParameter(f"{part}: unknown; there are {known}", param_hint="part")
    parts = list(PARTS) if part == _ALL else [part]
    page, numbers = out / "index.html", out / "numbers.json"
    require_folder(out)
    if out.is_dir():
        require_place(page, replaces=PAGE_BEGIN)
        require_place(numbers, replaces=_NUMBERS_BEGIN)
    with WorkProgress("reproduce") as progress:
        made = reproduce_paper(parts, asked.seed, progress)
    end, failure = f"\n\npage: {page}\nnumbers: {numbers}", None
    written = to_json(made.document).decode() + "\n"
    try:
        write_files({page: write_html(made)}, replaces=PAGE_BEGIN)
        write_files({numbers: written}, replaces=_NUMBERS_BEGIN)
    except NewFileError as error:
        end, failure = "", error
    print_report(made, as_json=asked.as_json, failure=failure, end=end)


def manual(
    page: Annotated[
        str | None,
        typer.Argument(metavar="[PAGE]", help="Page to read", show_default="the list of all pages"),
    ] = None,
) -> None:
    """List the pages of the manual, or print one of them."""
    from pamctl.manual import UnknownPageError, list_pages, read_page

    if page is None:
        pages = list_pages()
        width = max(len(one.name) for one in pages)
        for kind, of_kind in groupby(pages, key=lambda one: one.kind):
            typer.echo(f"{kind}:")
            for one in of_kind:
                typer.echo(f"  {one.name:<{width}}  {one.title}")
        return
    try:
        text = read_page(page)
    except UnknownPageError as error:
        raise typer.BadParameter(str(error), param_hint="PAGE") from None
    if not sys.stdout.isatty():
        typer.echo(text.rstrip())
        return
    from rich.console import Console
    from rich.markdown import Markdown

    Console().print(Markdown(text))
