"""`pamctl disarm`: end the session."""

from __future__ import annotations

from pamctl.cli.daemon.ask import ask, print_answer
from pamctl.cli.options import JsonOption, SocketOption


def disarm(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """End the session; the next run homes again."""
    print_answer(ask(socket, "disarm"), "idle", as_json=as_json)
