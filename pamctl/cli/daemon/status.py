"""`pamctl status`: what the daemon is doing."""

from __future__ import annotations

import typer

from pamctl.cli.daemon.ask import ask
from pamctl.cli.options import JsonOption, SocketOption
from pamctl.cli.output import print_json


def status(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Show what the daemon is doing."""
    answer = ask(socket, "status")
    if as_json:
        print_json(answer)
        return
    from pamctl.live.feed import format_status

    typer.echo(format_status(answer))
