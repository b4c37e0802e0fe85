"""`pamctl compare`: how far a model is from a measurement."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json, require_writable, write_page


def compare(
    path: Annotated[Path, typer.Argument(metavar="LOG", help="Log that the models are held to")],
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
    as_json: JsonOption = False,
) -> None:
    """Drive models by the logged command, and compare them with the measurement."""
    require_writable(plot, "--plot")
    from pamctl.compare.compare_plants import compare_plants
    from pamctl.compare.compare_text import format_comparison, make_comparison_document
    from pamctl.log import read

    found = compare_plants(read(path), plants or [])
    if plot is not None:
        from pamctl.compare.compare_page import draw_comparison_page

        write_page(plot, draw_comparison_page(path.name, found).html(), "--plot")
    if as_json:
        print_json({**make_comparison_document(path, found), "plot": plot and str(plot)})
    else:
        typer.echo(format_comparison(path, found))
        if plot is not None:
            typer.echo(f"plots: {plot}")
