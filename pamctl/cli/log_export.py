"""`pamctl log export`: the ticks of a log for other tools."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.config import JsonOption
from pamctl.cli.log import LogArgument, exit_on_log_errors


def export_log(
    source: LogArgument,
    destination: Annotated[
        Path, typer.Argument(metavar="OUT", help="Its suffix names the format.")
    ],
    fields: Annotated[
        str | None, typer.Option("--fields", metavar="NAME,...", help="Columns, in this order.")
    ] = None,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="First time, by t_s.")
    ] = None,
    to_s: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Last time, by t_s.")
    ] = None,
    every: Annotated[
        int, typer.Option("--every", metavar="N", min=1, help="Every N-th tick, unfiltered.")
    ] = 1,
    as_json: JsonOption = False,
) -> None:
    """Write the ticks as .csv, .mat, .npz or .parquet; names carry the units, floats are exact."""
    from pamctl.log.export import export_ticks

    names = _parse_names(fields)
    with exit_on_log_errors(as_json=as_json):
        done = export_ticks(
            source, destination, fields=names, from_s=from_s, to_s=to_s, every=every
        )
    told = f"{done.destination}: {done.ticks} ticks, {len(done.fields)} columns"
    typer.echo(json.dumps(asdict(done), indent=2) if as_json else told)


def _parse_names(fields: str | None) -> list[str] | None:
    if fields is None:
        return None
    names = [name.strip() for name in fields.split(",") if name.strip()]
    if not names:
        raise typer.BadParameter(f"{fields!r} names no column", param_hint="--fields")
    return names
