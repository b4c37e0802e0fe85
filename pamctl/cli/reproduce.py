"""`pamctl reproduce`: the paper's figures and its Table IV from this software."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import PAGE_BEGIN, print_result
from pamctl.json_text import to_json
from pamctl.new_file import NewFileError, require_folder, require_place, write_files

_ALL = "all"
_NUMBERS_BEGIN = "{"


def reproduce(
    part: Annotated[
        str, typer.Argument(metavar="fig3|fig4|fig5|table4|all", help="Part of the paper")
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the page and the numbers")
    ],
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Seed of the simulated noise")
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Write DIR/index.html and DIR/numbers.json; every number is simulated now."""
    from pamctl.report.html_page import write_html
    from pamctl.reproduce.reproduction import PARTS, reproduce_paper

    if part not in (_ALL, *PARTS):
        known = ", ".join((*PARTS, _ALL))
        raise typer.BadParameter(f"{part}: unknown; there are {known}", param_hint="part")
    parts = list(PARTS) if part == _ALL else [part]
    page, numbers = out / "index.html", out / "numbers.json"
    require_folder(out)
    if out.is_dir():
        require_place(page, replaces=PAGE_BEGIN)
        require_place(numbers, replaces=_NUMBERS_BEGIN)
    made = reproduce_paper(parts, seed, lambda name: typer.echo(f"{name} ...", err=True))
    text, failure = f"page: {page}\nnumbers: {numbers}", None
    written = to_json(made.numbers).decode() + "\n"
    try:
        write_files({page: write_html(made.page)}, replaces=PAGE_BEGIN)
        write_files({numbers: written}, replaces=_NUMBERS_BEGIN)
    except NewFileError as error:
        text, failure = written, error
    print_result(made.numbers, lambda: text, failure, as_json=as_json)
