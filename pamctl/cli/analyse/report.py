"""`pamctl report`: a page for one run, or for several."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import InteractiveOption, JsonOption
from pamctl.cli.output import PAGE_BEGIN, print_json
from pamctl.new_file import require_place, write_files
from pamctl.plain_text import escape_name


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
    interactive: InteractiveOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write one self-contained HTML page with figures and plots of these logs."""
    from pamctl.log.reader import read_some
    from pamctl.report.html_page import write_html
    from pamctl.report.reported_run import REPORT_FIELDS
    from pamctl.report.run_page import compose_report, find_doubts

    logs = [read_some(path, REPORT_FIELDS) for path in paths]
    doubts = [find_doubts(log) for log in logs]
    for path, found in zip(paths, doubts, strict=True):
        for doubt in found:
            typer.echo(f"warning: {escape_name(str(path))}: {doubt}", err=True)
    target = out or paths[0].with_suffix(".html")
    require_place(target, replaces=PAGE_BEGIN)
    html = write_html(compose_report(logs, doubts), interactive=interactive)
    write_files({target: html}, replaces=PAGE_BEGIN)
    if as_json:
        print_json({"page": str(target), "bytes": len(html.encode()), "logs": paths})
    else:
        typer.echo(f"report: {target}")
