"""`pamctl daemon`: stay up, and do what clients ask."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.backend import BackendOption, check_backend, rig_name
from pamctl.cli.config import (
    ControllerOption,
    PlantOption,
    RigOption,
    RtOption,
    SeedOption,
    SetOption,
    config_errors_exit,
)
from pamctl.cli.linux import require_linux
from pamctl.cli.live import (
    DEFAULT_LIVE_PORT,
    LiveOption,
    LiveOriginOption,
    LivePortOption,
    port_of,
)
from pamctl.cli.socket_option import SocketOption
from pamctl.settings import DEFAULT_NAMES, resolve


def daemon(
    backend: BackendOption = None,
    controller: ControllerOption = None,
    rig: RigOption = None,
    plant: PlantOption = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
    rt: RtOption = None,
    socket: SocketOption = None,
    group: Annotated[
        str | None, typer.Option("--group", help="Who may steer, beside this user.")
    ] = None,
    logs: Annotated[
        Path, typer.Option("--logs", metavar="DIRECTORY", help="Where each run's log goes.")
    ] = Path("logs"),
    keep: Annotated[
        int | None, typer.Option("--keep", min=1, help="Remove the oldest logs beyond so many.")
    ] = None,
    idle_after_s: Annotated[
        float, typer.Option("--idle-after", metavar="SECONDS", min=1, help="Parked for so long.")
    ] = 600.0,
    live: LiveOption = False,
    live_port: LivePortOption = DEFAULT_LIVE_PORT,
    live_origins: LiveOriginOption = None,
) -> None:
    """Stay up: home, run experiments and hold positions as clients ask (pamctl start, goto ...)."""
    with config_errors_exit():
        settings = resolve(
            controller=controller,
            rig=rig_name(backend, rig),
            plant=plant,
            overrides=overrides or (),
            seed=seed,
            rt=rt,
        )
        check_backend(settings, backend, rig)
    names = {
        "controller": controller or DEFAULT_NAMES["controller"],
        "plant": plant or DEFAULT_NAMES["plant"],
        "rig": rig or rig_name(backend, rig) or DEFAULT_NAMES["rig"],
    }
    port = port_of(live, live_port)
    require_linux()
    from pamctl.cli.serving import ServiceOptions, serve  # no other verb has to wait for it
    from pamctl.daemon.client import own_socket

    options = ServiceOptions(
        socket or own_socket(), group, logs, keep, idle_after_s, port, live_origins or ()
    )
    sys.exit(int(serve(settings, names, options)))
