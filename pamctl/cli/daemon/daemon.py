"""`pamctl daemon`: stay up, and do what clients ask; `pamctl watch`: watch it at work."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.backend_option import BackendOption
from pamctl.cli.failure import Failed
from pamctl.cli.options import (
    ControllerOption,
    PlantOption,
    RigOption,
    RtOption,
    SeedOption,
    SetOption,
    SocketOption,
    require_linux,
    seconds_option,
)
from pamctl.cli.settings_from_options import read_file_gains, resolve_options
from pamctl.exit_codes import ExitCode
from pamctl.plant.model import PlantSettings
from pamctl.settings.resolve import RunSettings


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
        str | None,
        typer.Option(
            "--group",
            metavar="GROUP",
            help="Group that may steer the rig, besides this user",
            show_default="this user's group",
        ),
    ] = None,
    logs: Annotated[
        Path, typer.Option("--logs", metavar="DIRECTORY", help="Directory for the log of each run")
    ] = Path("logs"),
    keep: Annotated[
        int | None,
        typer.Option(
            "--keep",
            metavar="N",
            min=1,
            help="Number of the daemon's logs to keep; older ones are removed",
            show_default="all",
        ),
    ] = None,
    idle_after_s: Annotated[
        float,
        seconds_option("--idle-after", "Idle time before the session ends", at_least=1.0),
    ] = 600.0,
    monitor: Annotated[
        bool,
        typer.Option("--monitor", help="Compare every run with the plant file, and say if it fits"),
    ] = False,
    monitor_plant: Annotated[
        str | None,
        typer.Option(
            "--monitor-plant",
            metavar="NAME|FILE",
            help="Plant that --monitor compares with",
            show_default="that of --plant",
        ),
    ] = None,
    monitor_trips: Annotated[
        bool,
        typer.Option("--monitor-trips", help="Stop at the safe voltage at the monitor's alarm"),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print each event as one line of JSON")
    ] = False,
) -> None:
    """Stay up: home, run experiments and hold positions as clients such as `pamctl start` ask."""
    settings, names = resolve_options(
        backend, rig, overrides, controller=controller, plant=plant, seed=seed, rt=rt
    )
    if (monitor_plant is not None or monitor_trips) and not monitor:
        raise typer.BadParameter("--monitor-plant and --monitor-trips go with --monitor")
    del names["experiment"]  # each start names its own
    watched = _choose_watched_plant(settings, monitor_plant) if monitor else None
    require_linux()
    from pamctl.daemon.client import own_socket
    from pamctl.daemon.serving import ServiceOptions, serve_daemon  # no other verb waits for it

    options = ServiceOptions(
        socket or own_socket(),
        group,
        logs,
        keep,
        idle_after_s,
        announce=as_json,
        watched=watched,
        monitor_trips=monitor_trips,
        file_gains=read_file_gains(settings, names["controller"]),
    )
    raise typer.Exit(int(serve_daemon(settings, names, options)))


def _choose_watched_plant(settings: RunSettings, name: str | None) -> PlantSettings:
    """Return the plant that the monitor follows."""
    if name is None:
        return settings.plant
    watched, _ = resolve_options(None, None, None, plant=name)
    return watched.plant


def watch(
    web: Annotated[bool, typer.Option("--web", help="Serve a page to browsers of this PC")] = False,
    port: Annotated[
        int,
        typer.Option(
            "--port",
            metavar="PORT",
            min=0,
            max=65535,
            help="Port of the page; 0 picks a free one",
        ),
    ] = 8642,
    allow_control: Annotated[
        bool,
        typer.Option("--allow-control", help="Let the page of --web stop and move the muscle"),
    ] = False,
    socket: SocketOption = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--count",
            metavar="N",
            min=1,
            help="Number of lines or pictures, after which it ends",
            show_default="no end",
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one line of JSON ten times a second")
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
    # However it ends, the terminal gets its cursor back.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    if not web:
        from pamctl.live.feed import watch_in_terminal

        # Tell a script that asked for some lines or pictures that there was no daemon.
        if not watch_in_terminal(where, count, as_json=as_json) and count is not None:
            raise typer.Exit(ExitCode.UNAVAILABLE)
        return
    from pamctl.live.web import serve_page

    try:
        serve_page(where, port, allow_control=allow_control)
    except OSError as error:
        why = f"port {port}: {error.strerror or error}; choose another with --port"
        raise Failed(ExitCode.UNAVAILABLE, why) from error
