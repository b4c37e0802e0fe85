"""`pamctl daemon`: stay up, and do what clients ask; `pamctl watch`: watch it at work."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import typer

from pamctl.cli.failure import Failed
from pamctl.cli.options import SOCKET, Options, flag, option, require_linux, verb
from pamctl.cli.settings_from_options import LoopOptions, read_file_gains, resolve_options
from pamctl.exit_codes import ExitCode
from pamctl.plant.model import PlantSettings
from pamctl.settings.resolve import RunSettings


class DaemonOptions(LoopOptions):
    """`pamctl daemon`."""

    socket: Path | None = SOCKET
    group: str | None = option(
        "--group GROUP",
        "Group that may steer the rig, besides this user",
        shown="this user's group",
    )
    logs: Path = option("--logs DIRECTORY", "Directory for the log of each run", Path("logs"))
    keep: int | None = option(
        "--keep N", "Number of the daemon's logs to keep; older ones are removed",
        shown="all", low=1,
    )  # fmt: skip
    idle_after_s: float = option(
        "--idle-after SECONDS", "Idle time before the session ends", 600.0, low=1.0
    )
    monitor: bool = flag("--monitor", "Compare every run with the plant file, and say if it fits")
    monitor_plant: str | None = option(
        "--monitor-plant NAME|FILE", "Plant that --monitor compares with", shown="that of --plant"
    )
    monitor_trips: bool = flag("--monitor-trips", "Stop at the safe voltage at the monitor's alarm")
    as_json: bool = flag("--json", "Print each event as one line of JSON")


@verb
def daemon(asked: DaemonOptions) -> None:
    """Stay up: home, run experiments and hold positions as clients such as `pamctl start` ask."""
    settings, names = asked.resolve()
    if (asked.monitor_plant is not None or asked.monitor_trips) and not asked.monitor:
        raise typer.BadParameter("--monitor-plant and --monitor-trips go with --monitor")
    del names["experiment"]  # each start names its own
    watched = _choose_watched_plant(settings, asked.monitor_plant) if asked.monitor else None
    require_linux()
    from pamctl.daemon.client import own_socket
    from pamctl.daemon.serving import ServiceOptions, serve_daemon  # no other verb waits for it

    options = ServiceOptions(
        asked.socket or own_socket(),
        asked.group,
        asked.logs,
        asked.keep,
        asked.idle_after_s,
        announce=asked.as_json,
        watched=watched,
        monitor_trips=asked.monitor_trips,
        file_gains=read_file_gains(settings, names["controller"]),
    )
    raise typer.Exit(int(serve_daemon(settings, names, options)))


def _choose_watched_plant(settings: RunSettings, name: str | None) -> PlantSettings:
    """Return the plant that the monitor follows."""
    if name is None:
        return settings.plant
    watched, _ = resolve_options(None, None, None, plant=name)
    return watched.plant


class WatchOptions(Options):
    """`pamctl watch`."""

    web: bool = flag("--web", "Serve a page to browsers of this PC")
    port: int = option(
        "--port PORT", "Port of the page; 0 picks a free one", 8642, low=0, high=65535
    )
    allow_control: bool = flag("--allow-control", "Let the page of --web stop and move the muscle")
    socket: Path | None = SOCKET
    count: int | None = option(
        "--count N", "Number of lines or pictures, after which it ends", shown="no end", low=1
    )
    as_json: bool = flag("--json", "Print one line of JSON ten times a second")


@verb
def watch(asked: WatchOptions) -> None:
    """Show state, position, error, pressure, command and timing ten times a second."""
    if asked.allow_control and not asked.web:
        raise typer.BadParameter("it goes with --web; in the terminal there are the other verbs")
    if asked.web and (asked.as_json or asked.count is not None):
        raise typer.BadParameter("--json and --count are for the terminal and for pipes")
    require_linux()
    from pamctl.daemon.client import default_socket

    where = asked.socket or default_socket()
    # However it ends, the terminal gets its cursor back.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    if not asked.web:
        from pamctl.live.feed import watch_in_terminal

        # Tell a script that asked for some lines or pictures that there was no daemon.
        found = watch_in_terminal(where, asked.count, as_json=asked.as_json)
        if not found and asked.count is not None:
            raise typer.Exit(ExitCode.UNAVAILABLE)
        return
    from pamctl.live.web import serve_page

    try:
        serve_page(where, asked.port, allow_control=asked.allow_control)
    except OSError as error:
        why = f"port {asked.port}: {error.strerror or error}; choose another with --port"
        raise Failed(ExitCode.UNAVAILABLE, why) from error
