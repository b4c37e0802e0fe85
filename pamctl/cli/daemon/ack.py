"""`pamctl ack`: acknowledge a fault."""

from __future__ import annotations

from pamctl.cli.daemon.ask import ask, print_answer
from pamctl.cli.options import JsonOption, SocketOption


def ack(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Acknowledge a fault, so that the daemon runs again."""
    print_answer(ask(socket, "ack"), "acknowledged: {fault}", as_json=as_json)
