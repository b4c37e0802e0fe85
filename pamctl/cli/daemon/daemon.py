"""`pamctl daemon`: stay up, and do what clients ask."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.backend_option import BackendOption
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
