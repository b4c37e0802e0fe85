"""`pamctl compare`: how far a model is from a measurement."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import InteractiveOption, JsonOption
from pamctl.cli.output import PAGE_BEGIN, print_json, print_result
from pamctl.new_file import NewFileError, require_place, write_files
from pamctl.plain_text import escape_name


def compare(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Logs that the models are held to, one by one"),
    ],
    plants: Annotated[
        list[str] | None,
        typer.Option(
            "--plant",
            metavar="NAME|FILE",
            help="Plant file with a model to compare; can be repeated",
            show_default="the log's own, else paper",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            "--plot", metavar="FILE", help="HTML page with plots to write", show_default="no page"
        ),
    ] = None,
    interactive: InteractiveOption = False,
    as_json: JsonOption = False,
) -> None:
    """Drive models by the logged command, and compare them with the measurement."""
    if plot is not None and len(paths) > 1:
        raise typer.BadParameter("a page is of one log; leave out the others", param_hint="--plot")
    if interactive and plot is None:
        raise typer.BadParameter("there is no page; give --plot too", param_hint="--interactive")
    if plot is not None:
        require_place(plot, replaces=PAGE_BEGIN)
    from pamctl.compare.comparison import compare_plants
    from pamctl.compare.comparison_report import report_comparison
    from pamctl.log.measured_signals import SIGNAL_FIELDS, judge_ticks
    from pamctl.log.reader import read, read_some
    from pamctl.report.html_page import write_html
    from pamctl.report.progress_line import WorkProgress
    from pamctl.report.report import format_terminal

    found = []
    with WorkProgress("compare") as progress:
        for number, path in enumerate(paths):
            progress(number, len(paths), f"reading {path.name}")
            log = read_some(path, SIGNAL_FIELDS)
            for doubt in judge_ticks(log):
                typer.echo(f"warning: {escape_name(str(path))}: {doubt}", err=True)
            begun = partial(_show_plant, progress, number, len(paths))
            found.append((path, compare_plants(log, plants or [], begun)))
        whole = None if plot is None else read(paths[0])
        reports = [report_comparison(path, models, whole) for path, models in found]
    if len(reports) > 1:
        if as_json:
            print_json([{**report.document, "plot": None} for report in reports])
        else:
            typer.echo("\n\n".join(map(format_terminal, reports)))
        return
    (report,) = reports
    failure = None
    if plot is not None:
        try:
            write_files({plot: write_html(report, interactive=interactive)}, replaces=PAGE_BEGIN)
        except NewFileError as error:
            failure = error
    saved = None if plot is None or failure else str(plot)
    end = f"\nplots: {saved}" if saved else ""
    document = {**report.document, "plot": saved}
    print_result(document, lambda: format_terminal(report) + end, failure, as_json=as_json)


def _show_plant(
    progress: Callable[[float, float, str], None], log: int, logs: int, done: float, of: float,
    doing: str,
) -> None:  # fmt: skip
    progress(log + done / of, logs, doing)
