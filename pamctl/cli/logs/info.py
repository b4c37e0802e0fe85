"""`pamctl log info`: what a log holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from pamctl.cli.failure import print_error
from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json
from pamctl.exit_codes import ExitCode
from pamctl.plain_text import escape_name


def show_info(
    path: Annotated[Path, typer.Argument(metavar="LOG", help="Log to look into")],
    as_json: JsonOption = False,
) -> None:
    """Show what a log holds: run, ticks, gaps, phases, channels, outcome.

    Of a damaged or unfinished log it shows what stands before the damage, and exits with 3.
    """
    from pamctl.log import info
    from pamctl.log.run_meta import CHANGES, spell_controller

    found = info(path)
    if as_json:
        print_json(found)
    else:
        found["path"] = escape_name(found["path"])
        if found["outcome"]:
            found["outcome"] = f"{found['outcome']['code']}: {found['outcome']['reason']}"
        if str(found["start"]).startswith("1970-01-01"):
            found["start"] = "none (simulated without a clock)"
        changes = found.pop(CHANGES)
        found["controller"] = spell_controller({**found, CHANGES: changes}) or None
        typer.echo("\n".join(_format_info(found)))
    if not found["complete"]:
        fix = f"save all that is whole with `pamctl log recover {path} DESTINATION`"
        print_error(f"{path} is damaged, or not finished: {fix}")
        raise typer.Exit(ExitCode.CHECK_FAILED)


def _format_info(found: dict[str, Any]) -> list[str]:
    """Return a line for each thing that is known."""
    return [
        f"{name.replace('_', ' '):<16}{_format_value(value)}"
        for name, value in found.items()
        if value not in (None, {}, [], "")
    ]


def _format_value(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_format_value(part)}" for name, part in value.items())
    if isinstance(value, list):
        return " ".join(map(str, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
