"""`pamctl log recover`: save all that is whole of a damaged log."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json
from pamctl.exit_codes import ExitCode
from pamctl.plain_text import escape_name

if TYPE_CHECKING:
    from pamctl.log.recover import Recovery


def recover_log(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Damaged log")],
    destination: Annotated[Path, typer.Argument(metavar="OUT", help="New log")],
    as_json: JsonOption = False,
) -> None:
    """Save all that is whole of a damaged log into a new file; exits with 3 if anything is lost."""
    from pamctl.log.recover import recover_file

    recovery = recover_file(source, destination)
    if as_json:
        print_json(asdict(recovery))
    else:
        typer.echo("\n".join(_format_recovery(recovery)))
    raise typer.Exit(ExitCode.OK if recovery.lossless else ExitCode.CHECK_FAILED)


def _format_recovery(recovery: Recovery) -> list[str]:
    saved = ", ".join(f"{count} of {topic}" for topic, count in recovery.messages.items())
    lines = [f"{escape_name(recovery.destination)}: saved {saved}"]
    lines += [f"  damage   {what}" for what in recovery.damage]
    if not recovery.lossless:
        lines.append(f"  lost     {recovery.bytes_lost} bytes that nothing could be made of")
    if recovery.unverified:
        lines.append(
            f"  doubtful no checksum vouches for the metadata {', '.join(recovery.unverified)}"
        )
    return lines
