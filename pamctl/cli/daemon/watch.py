"""`pamctl watch`: watch the daemon at work, in the terminal or in a browser."""

from __future__ import annotations

import signal
import sys
from typing import Annotated

import typer

from pamctl.cli.failure import Failed
from pamctl.cli.options import SocketOption, require_linux
from pamctl.exit_codes import ExitCode


def watch(
    web: Annotated[bool, typer.Option("--web", help="Serve a page to browsers of this PC")] = False,
    port: Annotated[
        int,
        typer.Option(
            "--port",
            metavar="PORT",
            min=0,
            max=65535,
            help="Port of the page; 0 picks a free one",
        ),
    ] = 8642,
    allow_control: Annotated[
        bool,
        typer.Option("--allow-control", help="Let the page of --web stop and move the muscle"),
    ] = False,
    socket: SocketOption = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--count",
            metavar="N",
            min=1,
            help="Number of lines or pictures, after which it ends",
            show_default="no end",
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one line of JSON ten times a second")
    ] = False,
) -> None:
    """Show state, position, error, pressure, command and timing ten times a second."""
    if allow_control and not web:
        raise typer.BadParameter("it goes with --web; in the terminal there are the other verbs")
    if web and (as_json or count is not None):
        raise typer.BadParameter("--json and --count are for the terminal and for pipes")
    require_linux()
    from pamctl.daemon.client import default_socket

    where = socket or default_socket()
    # However it ends, the terminal gets its cursor back.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    if not web:
        from pamctl.live.feed import watch_in_terminal

        # Tell a script that asked for some lines or pictures that there was no daemon.
        if not watch_in_terminal(where, count, as_json=as_json) and count is not None:
            raise typer.Exit(ExitCode.UNAVAILABLE)
        return
    from pamctl.live.web import serve_page

    try:
        serve_page(where, port, allow_control=allow_control)
    except OSError as error:
        why = f"port {port}: {error.strerror or error}; choose another with --port"
        raise Failed(ExitCode.UNAVAILABLE, why) from error
