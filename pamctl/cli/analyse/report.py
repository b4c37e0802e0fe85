"""`pamctl report`: a page for one run, or for several."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json, require_writable, write_page


def report(
    paths: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs to report on")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.html",
            help="HTML page to write",
            show_default="beside the first log",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write one self-contained HTML page with figures and plots of these logs."""
    require_writable(out, "--out")
    from pamctl.log import read
    from pamctl.report.compose import compose_report

    html = compose_report([read(path) for path in paths]).html()
    target = out or paths[0].with_suffix(".html")
    write_page(target, html)
    if as_json:
        print_json({"page": str(target), "bytes": len(html.encode()), "logs": paths})
    else:
        typer.echo(f"report: {target}")
