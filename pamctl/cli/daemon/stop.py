"""`pamctl stop`: end what is running, smoothly."""

from __future__ import annotations

from pamctl.cli.daemon.ask import ask, print_answer
from pamctl.cli.options import JsonOption, SocketOption


def stop(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Stop what is running, smoothly; the muscle stays homed."""
    print_answer(ask(socket, "stop"), "stopping", as_json=as_json)
