"""`pamctl report`: a page for one run, or for several."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.config import JsonOption
from pamctl.cli.offline import exit_on_bad_data, print_json, require_writable, write_page


def report(
    paths: Annotated[list[Path], typer.Argument(metavar="LOG...")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.html", help="The page; beside the first log."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write one self-contained HTML page with figures and plots of these logs."""
    require_writable(out, "--out")
    with exit_on_bad_data(as_json=as_json):
        from pamctl.log import read
        from pamctl.report.compose import compose_report as composed

        html = composed([read(path) for path in paths]).html()
    target = out or paths[0].with_suffix(".html")
    write_page(target, html)
    if as_json:
        print_json({"page": str(target), "bytes": len(html.encode()), "logs": paths})
    else:
        typer.echo(f"report: {target}")
