"""`pamctl watch`: look on while the daemon works, in the terminal or in a browser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.failure import fail
from pamctl.cli.linux import require_linux
from pamctl.cli.socket_option import SocketOption
from pamctl.realtime.ending import ExitCode

if TYPE_CHECKING:
    from pamctl.live.feed import Glimpse


def watch(
    web: Annotated[bool, typer.Option("--web", help="In a browser of this PC.")] = False,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Of --web; 0 is any that is free.")
    ] = 8642,
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="With --web: stop, goto, and emergency stop.")
    ] = False,
    socket: SocketOption = None,
) -> None:
    """Show state, position, error, pressure, command and timing ten times a second."""
    if allow_control and not web:
        raise typer.BadParameter("it goes with --web; in the terminal there are the other verbs")
    require_linux()
    from pamctl.daemon.client import default_socket

    where = socket or default_socket()
    if not web:
        from pamctl.live.terminal import watch_in_terminal

        watch_in_terminal(where, plain_line)
        return
    from pamctl.live.web import serve_page

    try:
        serve_page(where, port, allow_control=allow_control)
    except OSError as error:
        why = f"port {port}: {error.strerror or error}; choose another with --port"
        fail(ExitCode.UNAVAILABLE, why)


def plain_line(glimpse: Glimpse) -> str:
    """Write a glimpse as one line, for a file or a pipe."""
    from pamctl.cli.steer import status_text

    if glimpse.status is None:
        return f"away: {glimpse.problem}"
    return "  ".join(status_text(glimpse.status).splitlines()[:2])
