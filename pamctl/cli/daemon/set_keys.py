"""`pamctl set`: change gains while the loop runs."""

from __future__ import annotations

import getpass
from contextlib import suppress
from typing import Annotated

import typer

from pamctl.cli.daemon.ask import ask, print_gains, ramp_option
from pamctl.cli.options import JsonOption, SocketOption
from pamctl.realtime.gain_ramp import DEFAULT_RAMP_S


def set_keys(
    changes: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY=VALUE...", help="Gains to change, such as controller.lambda_per_s=12"
        ),
    ],
    ramp_s: Annotated[float, ramp_option()] = DEFAULT_RAMP_S,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Change gains while the loop runs, on a ramp."""
    who = _find_user()
    gains = ask(socket, "set", {"changes": changes, "ramp_s": ramp_s, "operator": who})
    print_gains(gains, as_json=as_json)


def _find_user() -> str:
    """Return the user's name, for the log; empty where this PC does not know one."""
    with suppress(KeyError, OSError):
        return getpass.getuser()
    return ""
