"""`pamctl gains`: load and show the daemon's gains."""

from __future__ import annotations

from typing import Annotated

import typer

from pamctl.cli.daemon.ask import ask, print_gains, ramp_option, read_section
from pamctl.cli.options import JsonOption, SocketOption
from pamctl.log.run_meta import file_safe_name
from pamctl.realtime.gain_ramp import DEFAULT_RAMP_S

gains_app = typer.Typer(no_args_is_help=True, help="Load and show the daemon's gains.")


@gains_app.command("load")
def load(
    file: Annotated[
        str, typer.Argument(metavar="NAME|FILE", help="Controller file with the new gains")
    ],
    ramp_s: Annotated[float, ramp_option()] = DEFAULT_RAMP_S,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take the gains of a controller file, on a ramp; another law only between runs."""
    data = read_section("controller", file)
    params = {"controller": data, "name": file_safe_name(file), "ramp_s": ramp_s}
    print_gains(ask(socket, "load", params), as_json=as_json)


@gains_app.command("show")
def show(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Print the gains in use, as a controller file."""
    print_gains(ask(socket, "status")["controller"], as_json=as_json)
