"""The clients of the daemon: `pamctl status start stop estop ack set gains goto mark`."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from pamctl.cli.config import JsonOption, exit_on_config_errors, find_argument_file
from pamctl.cli.failure import fail
from pamctl.cli.linux import require_linux
from pamctl.cli.progress import format_progress
from pamctl.cli.seconds import at_least, more_than
from pamctl.cli.socket_option import SocketOption
from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError, default_socket
from pamctl.daemon.protocol import LONGEST_MOTION_S, LONGEST_REMARK
from pamctl.exit_codes import ExitCode
from pamctl.log.naming import file_safe_name
from pamctl.realtime.gain_ramp import DEFAULT_RAMP_S
from pamctl.settings.resolve import SECTIONS, RawSettings, settings_to_data, validate_settings
from pamctl.settings.yaml12 import dump_yaml

RampOption = Annotated[
    float,
    typer.Option(
        "--ramp", metavar="SECONDS", callback=at_least(0.0, 60.0), help="Of the change; 60 at most."
    ),
]

_METRES = {"": 1e-3, "mm": 1e-3, "m": 1.0, "um": 1e-6, "in": 25.4e-3}

gains_app = typer.Typer(no_args_is_help=True, help="Load and show the daemon's gains.")


def ask(socket: Path | None, method: str, params: Mapping[str, object] | None = None) -> Any:
    """Ask the daemon; leave with one line where it cannot be asked or says no."""
    require_linux()
    try:
        with Client(socket or default_socket()) as client:
            return client.call(method, params)
    except KeyboardInterrupt:
        print("asked already: pamctl status says what became of it", file=sys.stderr)
        raise
    except DaemonUnreachableError as error:
        fail(ExitCode.UNAVAILABLE, str(error))
    except DaemonDeclinedError as error:
        fail(ExitCode.CHECK_FAILED, str(error))


def status(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Say what the daemon is doing."""
    told = ask(socket, "status")
    typer.echo(json.dumps(told, indent=2) if as_json else format_status(told))


def format_status(told: Mapping[str, Any]) -> str:
    """Write a status for people."""
    what = f": {told['fault']}" if told["fault"] else f" ({told['run']})" if told["run"] else ""
    lines = [f"{told['state']}{what}, {told['backend']} {told['device']}"]
    if told["tick"] is not None:
        tick = {k: float("nan") if v is None else v for k, v in told["tick"].items()}
        lines.append(format_progress(tick, told["worst_late_s"]).strip())
    if told["log"]:
        lines.append(f"log: {told['log']}")
    lines.append(f"disk: {told['disk_free_bytes'] / 1e9:.1f} GB free")
    return "\n".join(lines)


def start(
    experiment: Annotated[str, typer.Argument(metavar="NAME|FILE", help="As of pamctl run.")],
    duration_s: Annotated[
        float | None,
        typer.Option(
            "--duration", metavar="SECONDS", callback=more_than(0.0), help="End it early."
        ),
    ] = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run an experiment; home first if the muscle is not."""
    data = _read_section("experiment", experiment, as_json=as_json)
    params = {"experiment": data, "name": file_safe_name(experiment), "duration_s": duration_s}
    _print_answer(ask(socket, "start", params), "log: {log}", as_json=as_json)


def stop(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Stop what is running, smoothly; the muscle stays homed."""
    _print_answer(ask(socket, "stop"), "stopping", as_json=as_json)


def estop(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Emergency stop: the safe voltage within a tick; latched until `pamctl ack`."""
    _print_answer(ask(socket, "estop"), "emergency stop", as_json=as_json)


def ack(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Acknowledge a fault."""
    _print_answer(ask(socket, "ack"), "acknowledged: {fault}", as_json=as_json)


def disarm(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """End the session: idle, and the next run homes anew."""
    _print_answer(ask(socket, "disarm"), "idle", as_json=as_json)


def goto(
    position: Annotated[str, typer.Argument(metavar="POSITION", help="12mm, 0.012m, 12")],
    within_s: Annotated[
        float | None,
        typer.Option(
            "--in",
            metavar="SECONDS",
            callback=more_than(0.0, LONGEST_MOTION_S),
            help="4 mm/s if absent.",
        ),
    ] = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Go to a position and hold it."""
    params = {"position_m": parse_position_m(position), "within_s": within_s}
    _print_answer(ask(socket, "goto", params), "log: {log}", as_json=as_json)


def parse_position_m(text: str) -> float:
    """Read a length; a bare number is in mm."""
    found = re.fullmatch(r"\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*([a-z]*)\s*", text)
    try:
        assert found is not None
        length_m = float(found[1]) * _METRES[found[2]]
        assert math.isfinite(length_m)
        return length_m
    except (AssertionError, KeyError, ValueError):
        raise typer.BadParameter(f"'{text}' is no position; write 12mm or 0.012m") from None


def set_keys(
    changes: Annotated[
        list[str], typer.Argument(metavar="KEY=VALUE...", help="controller.lambda_per_s=12")
    ],
    ramp_s: RampOption = DEFAULT_RAMP_S,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Change gains while the loop runs, on a ramp."""
    gains = ask(socket, "set", {"changes": changes, "ramp_s": ramp_s})
    typer.echo(json.dumps(gains, indent=2) if as_json else dump_yaml(gains).rstrip())


def check_remark(text: str) -> str:
    """Pass a remark on; leave with 2 where it is empty, or longer than the daemon takes."""
    if not 1 <= len(text) <= LONGEST_REMARK:
        told = f"must have 1 to {LONGEST_REMARK} characters (got {len(text)})"
        raise typer.BadParameter(told)
    return text


def mark(
    text: Annotated[str, typer.Argument(callback=check_remark, help="What to remember.")],
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Put a remark into the log of the run that goes on."""
    _print_answer(ask(socket, "mark", {"text": text}), "marked", as_json=as_json)


@gains_app.command("load")
def load(
    file: Annotated[str, typer.Argument(metavar="NAME|FILE", help="A controller file.")],
    ramp_s: RampOption = DEFAULT_RAMP_S,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take the gains of a controller file, on a ramp; another law only between runs."""
    data = _read_section("controller", file, as_json=as_json)
    gains = ask(
        socket, "load", {"controller": data, "name": file_safe_name(file), "ramp_s": ramp_s}
    )
    typer.echo(json.dumps(gains, indent=2) if as_json else dump_yaml(gains).rstrip())


@gains_app.command("show")
def show(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Print the gains in use, as a controller file."""
    gains = ask(socket, "status")["controller"]
    typer.echo(json.dumps(gains, indent=2) if as_json else dump_yaml(gains).rstrip())


def _read_section(section: str, name: str, *, as_json: bool) -> dict[str, Any]:
    """Read and check a file here, where its lines can be named."""
    file = find_argument_file(section, name)
    with exit_on_config_errors(as_json=as_json):
        return settings_to_data(
            validate_settings(SECTIONS[section], RawSettings.read(file), title=section)
        )


def _print_answer(answer: Any, text: str, *, as_json: bool) -> None:
    typer.echo(json.dumps(answer, indent=2) if as_json else text.format(**(answer or {})))
