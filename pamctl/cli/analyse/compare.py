"""`pamctl compare`: how far a model is from a measurement."""

from __future__ import annotations

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
    from pamctl.compare.comparison_report import format_comparison, make_comparison_document
    from pamctl.log.measured_signals import SIGNAL_FIELDS, judge_ticks
    from pamctl.log.reader import read, read_some

    found = []
    for path in paths:
        log = read_some(path, SIGNAL_FIELDS)
        for doubt in judge_ticks(log):
            typer.echo(f"warning: {escape_name(str(path))}: {doubt}", err=True)
        found.append((path, compare_plants(log, plants or [])))
    if len(found) > 1:
        if as_json:
            print_json([{**make_comparison_document(*one), "plot": None} for one in found])
        else:
            typer.echo("\n\n".join(format_comparison(*one) for one in found))
        return
    ((path, models),) = found
    failure = None
    if plot is not None:
        from pamctl.compare.comparison_report import draw_comparison_page
        from pamctl.report.html_page import write_html

        page = write_html(draw_comparison_page(read(path), models), interactive=interactive)
        try:
            write_files({plot: page}, replaces=PAGE_BEGIN)
        except NewFileError as error:
            failure = error
    saved = None if plot is None or failure else str(plot)
    document = {**make_comparison_document(path, models), "plot": saved}
    end = f"\nplots: {saved}" if saved else ""
    print_result(document, lambda: format_comparison(path, models) + end, failure, as_json=as_json)
