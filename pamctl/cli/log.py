"""`pamctl log`: what is in a log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from pamctl.cli.config import JsonOption
from pamctl.realtime.ending import ExitCode

log_app = typer.Typer(no_args_is_help=True, help="Look into logs.")


@log_app.callback()
def _group() -> None:
    """Keep the verb `info` a verb while it is the only one."""


@log_app.command("info")
def show_info(
    path: Annotated[Path, typer.Argument(metavar="LOG")], as_json: JsonOption = False
) -> None:
    """Say what a log holds: run, ticks, gaps, phases, channels, outcome."""
    from pamctl.log.reader import LogError, info

    try:
        found = info(path)
    except LogError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(ExitCode.BAD_DATA) from None
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    if found["outcome"]:
        found["outcome"] = f"{found['outcome']['code']}: {found['outcome']['reason']}"
    typer.echo("\n".join(_lines(found)))


def _lines(found: dict[str, Any]) -> list[str]:
    """Lay out what is known, a line each; what is not known is left out."""
    return [
        f"{name.replace('_', ' '):<16}{_shown(value)}"
        for name, value in found.items()
        if value not in (None, {}, [])
    ]


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(part)}" for name, part in value.items())
    return f"{value:.6g}" if isinstance(value, float) else str(value)
