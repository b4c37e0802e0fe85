"""`pamctl watch`: look on while the daemon works, in the terminal or in a browser."""

from __future__ import annotations

import signal
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.failure import fail
from pamctl.cli.linux import require_linux
from pamctl.cli.socket_option import SocketOption
from pamctl.exit_codes import ExitCode

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
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Lines, or pictures; without end.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="A line of JSON ten times a second, as the page has it.")
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
    # Whatever ends it, a terminal gets its cursor and its lines back.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    if as_json:
        from pamctl.live.terminal import watch_as_json

        _require_seen(watch_as_json(where, count), count)
        return
    if not web:
        from pamctl.live.terminal import watch_in_terminal

        _require_seen(watch_in_terminal(where, format_glimpse, count), count)
        return
    from pamctl.live.web import serve_page

    try:
        serve_page(where, port, allow_control=allow_control)
    except OSError as error:
        why = f"port {port}: {error.strerror or error}; choose another with --port"
        fail(ExitCode.UNAVAILABLE, why)


def _require_seen(seen: bool, count: int | None) -> None:
    """A script that asks for so many looks is told that there was nothing to see."""
    if count is not None and not seen:
        raise typer.Exit(ExitCode.UNAVAILABLE)


def format_glimpse(glimpse: Glimpse) -> str:
    """Write a glimpse as one line, for a file or a pipe."""
    from pamctl.cli.steer import format_status

    if glimpse.status is None:
        return f"away: {glimpse.problem}"
    return "  ".join(format_status(glimpse.status).splitlines()[:2])
