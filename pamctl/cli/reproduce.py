"""`pamctl reproduce`: the paper's figures and its Table IV from this software."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.config import JsonOption
from pamctl.cli.offline import print_json, require_writable, write_page

_ALL = "all"


def reproduce(
    part: Annotated[str, typer.Argument(metavar="fig3|fig4|fig5|table4|all")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the page goes.")],
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Of the noise.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Write DIR/index.html and DIR/numbers.json; every number is simulated now."""
    from pamctl.json_text import to_json
    from pamctl.reproduce.reproduction import PARTS
    from pamctl.reproduce.reproduction import reproduce_paper as reproduced

    if part not in (_ALL, *PARTS):
        known = ", ".join((*PARTS, _ALL))
        raise typer.BadParameter(f"{part}: unknown; there are {known}", param_hint="part")
    parts = list(PARTS) if part == _ALL else [part]
    page, numbers = out / "index.html", out / "numbers.json"
    _make_folder(out)
    for file in (page, numbers):
        require_writable(file, "--out")
    made = reproduced(parts, seed, lambda name: typer.echo(f"{name} ...", err=True))
    write_page(page, made.page.html())
    write_page(numbers, to_json(made.numbers).decode() + "\n")
    if as_json:
        print_json(made.numbers)
    else:
        typer.echo(f"page: {page}\nnumbers: {numbers}")


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"cannot make the directory {path}: {error.strerror}"
        raise typer.BadParameter(message, param_hint="--out") from None
