"""`pamctl daemon`: stay up, and do what clients ask."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.backend import BackendOption
from pamctl.cli.config import (
    ControllerOption,
    PlantOption,
    RigOption,
    RtOption,
    SeedOption,
    SetOption,
    resolve_options,
)
from pamctl.cli.linux import require_linux
from pamctl.cli.live import (
    DEFAULT_LIVE_PORT,
    LiveOption,
    LiveOriginOption,
    LivePortOption,
    check_live_port,
)
from pamctl.cli.seconds import at_least
from pamctl.cli.socket_option import SocketOption


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
        int | None, typer.Option("--keep", min=1, help="Remove its oldest logs beyond so many.")
    ] = None,
    idle_after_s: Annotated[
        float,
        typer.Option(
            "--idle-after", metavar="SECONDS", callback=at_least(1.0), help="Parked for so long."
        ),
    ] = 600.0,
    live: LiveOption = False,
    live_port: LivePortOption = DEFAULT_LIVE_PORT,
    live_origins: LiveOriginOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="A line of JSON for whatever happens.")
    ] = False,
) -> None:
    """Stay up: home, run experiments and hold positions as clients ask (pamctl start, goto ...)."""
    settings, names = resolve_options(
        backend,
        rig,
        overrides,
        as_json=as_json,
        controller=controller,
        plant=plant,
        seed=seed,
        rt=rt,
    )
    del names["experiment"]  # that is said when it is started
    origins = live_origins or ()
    port = check_live_port(live, live_port, origins)
    require_linux()
    from pamctl.daemon.client import own_socket
    from pamctl.daemon.serving import (  # no other verb has to wait for it
        ServiceOptions,
        serve_daemon,
    )

    options = ServiceOptions(
        socket or own_socket(), group, logs, keep, idle_after_s, port, origins, as_json
    )
    sys.exit(int(serve_daemon(settings, names, options)))
