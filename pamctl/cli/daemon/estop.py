"""`pamctl estop`: emergency stop."""

from __future__ import annotations

from pamctl.cli.daemon.ask import ask, print_answer
from pamctl.cli.options import JsonOption, SocketOption


def estop(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Drive the safe voltage within a tick; latched until `pamctl ack`."""
    print_answer(ask(socket, "estop"), "emergency stop", as_json=as_json)
