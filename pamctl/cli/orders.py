"""The verbs of the daemon's clients: an order of `daemon/rig_session.py` each, and `pamctl watch`.

A verb is made of its order: the signature says arguments, options, ranges and help. Written here
are those that read a file, or that print more than the answer. Verbs without arguments are made of
the table in `cli/verbs.py` alone: an emergency stop waits for no import.
"""

from __future__ import annotations

import getpass
import inspect
import math
import re
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pamctl.base.errors import ExitCode
from pamctl.base.texts import LONGEST_REMARK, clean_text
from pamctl.cli.failure import Failed
from pamctl.cli.options import (
    NO_CHANGES,
    SOCKET,
    AnnotationOptions,
    Options,
    argument,
    flag,
    list_fields,
    option,
    require_linux,
    verb,
)
from pamctl.cli.output import print_result
from pamctl.cli.verbs import VERBS

if TYPE_CHECKING:
    from pamctl.daemon.protocol import Order

_PLAIN = {
    "stop": "stopping",
    "estop": "emergency stop",
    "ack": "acknowledged: {fault}",
    "disarm": "idle",
}
"""Orders without arguments, each with what its verb prints."""
_METRES = {"": 1e-3, "mm": 1e-3, "m": 1.0, "um": 1e-6, "in": 25.4e-3}


class OrderOptions(Options):
    """What every order is asked."""

    socket: Path | None = SOCKET


# --- verbs that are made of their orders -----------------------------------------------------


def __getattr__(name: str) -> Callable[..., None]:
    """Make the verb of an order."""
    if name in _PLAIN:
        return _make_verb(name, VERBS[name].told, _PLAIN[name], [])
    if name.startswith("_"):
        raise AttributeError(name)
    from pamctl.daemon.protocol import list_orders
    from pamctl.daemon.rig_session import RigSession

    return make_verb(list_orders(RigSession)[name])


def make_verb(order: Order) -> Callable[..., None]:
    """Make the verb of an order from its signature.

    A parameter without default is an argument. The ending of a name is its unit: `_s` takes
    seconds, `_m` a length with a unit. `operator` is the user.
    """
    names = order.signature.parameters
    given = [_make_parameter(order, name) for name in names if name != "operator"]
    told = inspect.getdoc(order.body) or ""
    return _make_verb(order.name, told, order.said, given, "operator" in names)


def _make_verb(
    name: str, told: str, said: str, given: Sequence[inspect.Parameter], names_user: bool = False
) -> Callable[..., None]:
    def give_order(socket: Path | None, as_json: bool, **params: Any) -> None:
        user = {"operator": _find_user()} if names_user else {}
        answer = ask(socket, name, {**params, **user})
        if as_json or said or not answer:
            print_answer(answer, said, as_json=as_json)
        else:
            print_settings(answer, as_json=False)

    options = [*given, *list_fields(OrderOptions)]
    made: Any = give_order
    made.__signature__ = inspect.Signature(options)
    made.__annotations__ = {one.name: one.annotation for one in options}
    made.__name__, made.__doc__ = name, told
    return give_order


def _make_parameter(order: Order, name: str) -> inspect.Parameter:
    field = order.params.model_fields[name]
    extra: Any = field.json_schema_extra or {}
    limits = {type(each).__name__: each for each in field.metadata}
    bare, _, unit = name.rpartition("_")
    spelled = extra.get("option", f"--{bare if unit == 's' else name}".replace("_", "-"))
    shown: Any = {"help": field.description, "metavar": field.title}
    kind: Any = field.annotation
    made: Any
    if unit == "s":
        made = option(
            f"{spelled} SECONDS",
            field.description or "",
            shown=extra.get("default", True),
            low=getattr(limits.get("Ge"), "ge", None),
            above=getattr(limits.get("Gt"), "gt", None),
            high=getattr(limits.get("Le"), "le", None),
        ).info
    elif unit == "m":
        kind, made = str, typer.Argument(callback=parse_position_m, **shown)
    else:
        made = typer.Argument(**shown) if field.is_required() else typer.Option(spelled, **shown)
    default = inspect.Parameter.empty if field.is_required() else field.default
    keyword = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, keyword, default=default, annotation=Annotated[kind, made])


def parse_position_m(text: str) -> float:
    """Read a length in m; a bare number is in mm."""
    found = re.fullmatch(r"\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*([a-z]*)\s*", text)
    try:
        assert found is not None
        length_m = float(found[1]) * _METRES[found[2]]
        assert math.isfinite(length_m)
        return length_m
    except (AssertionError, KeyError, ValueError):
        raise typer.BadParameter(f"'{text}' is no position; write 12mm or 0.012m") from None


def _find_user() -> str:
    """Return the user's name, for the log; empty where this PC does not know one."""
    with suppress(KeyError, OSError):
        return getpass.getuser()
    return ""


# --- how they ask, and print the answer ------------------------------------------------------


def ask(socket: Path | None, method: str, params: Mapping[str, object] | None = None) -> Any:
    """Ask the daemon. Raises `DaemonUnreachableError` and `DaemonDeclinedError`."""
    require_linux()
    from pamctl.daemon.client import Client, default_socket

    try:
        with Client(socket or default_socket()) as client:
            return client.call(method, params)
    except KeyboardInterrupt:
        print("the request was sent; see `pamctl status` for what it did", file=sys.stderr)
        raise


def print_answer(answer: Any, text: str, *, as_json: bool) -> None:
    """Print the answer, or `text` filled with its fields for people."""
    print_result(answer, text.format(**(answer or {})), as_json=as_json)


def print_settings(settings: Mapping[str, Any], *, as_json: bool) -> None:
    """Print settings, for people as a file."""
    from pamctl.settings.yaml12 import dump_yaml

    print_result(settings, dump_yaml(settings).rstrip(), as_json=as_json)


def _read_section(section: str, name: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Read and check a file here, where its lines can be named; raise `ConfigError`."""
    from pamctl.cli.settings_from_options import find_argument_file
    from pamctl.settings.config_files import read_section

    return read_section(section, find_argument_file(section, name), overrides)


# --- verbs that do more ----------------------------------------------------------------------


@verb
def status(asked: OrderOptions) -> None:
    """Show what the daemon is doing."""
    answer = ask(asked.socket, "status")
    from pamctl.live.feed import format_status

    print_result(answer, format_status(answer), as_json=asked.as_json)


class StartOptions(OrderOptions, AnnotationOptions):
    """`pamctl start`."""

    experiment: str = argument("NAME|FILE", "Experiment to run, as for pamctl run")
    duration_s: float | None = option(
        "--duration SECONDS", "End the run this long after homing",
        shown="length of the experiment", above=0.0,
    )  # fmt: skip
    overrides: list[str] = option(
        "--set KEY=VALUE",
        "Key of the experiment to change, such as amplitude_mm=2; can be repeated",
        shown=NO_CHANGES,
    )


@verb
def start(asked: StartOptions) -> None:
    """Run an experiment; home first if the muscle is not homed."""
    from pamctl.log.run_meta import file_safe_name

    said = asked.make_annotation()
    params = {
        "experiment": _read_section("experiment", asked.experiment, asked.overrides),
        "name": file_safe_name(asked.experiment),
        "duration_s": asked.duration_s,
        **asdict(said),
        "tags": list(said.tags),
    }
    print_answer(ask(asked.socket, "start", params), "log: {log}", as_json=asked.as_json)


gains_app = typer.Typer(no_args_is_help=True, help="Load and show the daemon's gains.")


class LoadOptions(OrderOptions):
    """`pamctl gains load`."""

    file: str = argument("NAME|FILE", "Controller file with the new gains")
    ramp_s: float = option(
        "--ramp SECONDS", "Time over which the gains change", 0.5, low=0.0, high=60.0
    )


@gains_app.command("load")
@verb
def load_gains(asked: LoadOptions) -> None:
    """Take the gains of a controller file, on a ramp; another law only between runs."""
    from pamctl.log.run_meta import file_safe_name

    data = _read_section("controller", asked.file)
    params = {"controller": data, "name": file_safe_name(asked.file), "ramp_s": asked.ramp_s}
    print_settings(ask(asked.socket, "load", params), as_json=asked.as_json)


@gains_app.command("show")
@verb
def show_gains(asked: OrderOptions) -> None:
    """Print the gains in use, as a controller file."""
    print_settings(ask(asked.socket, "status")["controller"], as_json=asked.as_json)


def check_remark(text: str) -> str:
    """Return the remark without control characters; leave with 2 where it is empty or too long."""
    text = clean_text(text)
    if not 1 <= len(text) <= LONGEST_REMARK:
        message = f"must have 1 to {LONGEST_REMARK} characters (got {len(text)})"
        raise typer.BadParameter(message, param_hint="'TEXT'")
    return text


class MarkOptions(OrderOptions):
    """`pamctl mark`."""

    text: str = argument("TEXT", "Remark of 1 to 2000 characters")
    log: Path | None = option(
        "--log FILE", "Log of the run to mark, where several go on", shown="the only one"
    )


@verb
def mark(asked: MarkOptions) -> None:
    """Put a remark into the log of the run that goes on, of the daemon or of pamctl run."""
    text, log, socket = check_remark(asked.text), asked.log, asked.socket
    require_linux()
    from pamctl.processes.marks import list_running_runs, mark_run

    runs = [] if socket is not None else list_running_runs()
    if log is not None:
        runs = [run for run in runs if run.log == log.absolute()]
    elif runs:
        choices = [str(run.log) for run in runs] + _find_daemon_log()
        if len(choices) > 1:
            raise typer.BadParameter(
                f"several runs go on; choose one with --log: {', '.join(choices)}",
                param_hint="--log",
            )
    if runs:
        mark_run(runs[0], text)
        print_answer({"log": str(runs[0].log)}, "marked", as_json=asked.as_json)
        return
    if log is not None and _find_daemon_log(socket) != [str(log.absolute())]:
        raise Failed(ExitCode.CHECK_FAILED, f"no run that takes marks writes {log}")
    print_answer(ask(socket, "mark", {"text": text}), "marked", as_json=asked.as_json)


def _find_daemon_log(socket: Path | None = None) -> list[str]:
    """Return the log that a daemon writes now; empty where there is none."""
    from pamctl.daemon.client import DaemonDeclinedError, DaemonUnreachableError

    try:
        log = ask(socket, "status")["log"]
    except (DaemonUnreachableError, DaemonDeclinedError):
        return []
    return [] if log is None else [log]


# --- watch ------------------------------------------------------------------------------------


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
