"""`pamctl log export`: the ticks of a log for other tools."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json
from pamctl.plain_text import escape_name


def export_log(
    source: Annotated[Path, typer.Argument(metavar="LOG", help="Log to export")],
    destination: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="New file: .csv, .mat or .parquet"),
    ],
    fields: Annotated[
        str | None,
        typer.Option(
            "--fields",
            metavar="NAME,...",
            help="Columns to export, in this order",
            show_default="all columns",
        ),
    ] = None,
    from_s: Annotated[
        float | None,
        typer.Option(
            "--from",
            metavar="SECONDS",
            help="First time to export, by t_s",
            show_default="the beginning",
        ),
    ] = None,
    to_s: Annotated[
        float | None,
        typer.Option(
            "--to", metavar="SECONDS", help="Last time to export, by t_s", show_default="the end"
        ),
    ] = None,
    every: Annotated[
        int,
        typer.Option("--every", metavar="N", min=1, help="Export every N-th tick, unfiltered"),
    ] = 1,
    as_json: JsonOption = False,
) -> None:
    """Write the ticks for other tools; names carry the units, floats are exact."""
    from pamctl.log.export import export_ticks

    names = _parse_names(fields)
    done = export_ticks(source, destination, fields=names, from_s=from_s, to_s=to_s, every=every)
    if as_json:
        print_json(asdict(done))
    else:
        typer.echo(
            f"{escape_name(done.destination)}: {done.ticks} ticks, {len(done.fields)} columns"
        )


def _parse_names(fields: str | None) -> list[str] | None:
    if fields is None:
        return None
    names = [name.strip() for name in fields.split(",") if name.strip()]
    if not names:
        raise typer.BadParameter(f"{fields!r} names no column", param_hint="--fields")
    return names
