"""`pamctl reproduce`: the paper's figures and its Table IV from this software."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import make_folder, print_json, require_writable, write_page
from pamctl.json_text import to_json

_ALL = "all"


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
    from pamctl.reproduce.reproduction import PARTS, reproduce_paper

    if part not in (_ALL, *PARTS):
        known = ", ".join((*PARTS, _ALL))
        raise typer.BadParameter(f"{part}: unknown; there are {known}", param_hint="part")
    parts = list(PARTS) if part == _ALL else [part]
    page, numbers = out / "index.html", out / "numbers.json"
    make_folder(out, "--out")
    for file in (page, numbers):
        require_writable(file, "--out")
    made = reproduce_paper(parts, seed, lambda name: typer.echo(f"{name} ...", err=True))
    write_page(page, made.page.html())
    write_page(numbers, to_json(made.numbers).decode() + "\n")
    if as_json:
        print_json(made.numbers)
    else:
        typer.echo(f"page: {page}\nnumbers: {numbers}")
