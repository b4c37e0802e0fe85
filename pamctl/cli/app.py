"""The command line: `pamctl VERB`, with its verbs in groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Annotated, Any, NamedTuple

import typer

from pamctl import __version__
from pamctl.cli.failure import Verbs
from pamctl.settings.resolve import SECTIONS, list_shipped


class _Verb(NamedTuple):
    """Where a verb is, and its group in the help."""

    panel: str
    place: str
    """`module:attribute` below `pamctl.cli`: a function, or a `Typer` with verbs of its own."""
    context: Mapping[str, Any] = {}


_VERBS: Mapping[str, _Verb] = {
    "run": _Verb("Run", "rig.run:run"),
    "daemon": _Verb("Daemon", "daemon.daemon:daemon"),
    "status": _Verb("Daemon", "daemon.status:status"),
    "start": _Verb("Daemon", "daemon.start:start"),
    "stop": _Verb("Daemon", "daemon.stop:stop"),
    "estop": _Verb("Daemon", "daemon.estop:estop"),
    "ack": _Verb("Daemon", "daemon.ack:ack"),
    "disarm": _Verb("Daemon", "daemon.disarm:disarm"),
    "mark": _Verb("Daemon", "daemon.mark:mark"),
    "watch": _Verb("Daemon", "daemon.watch:watch"),
    "report": _Verb("Analyse", "analyse.report:report"),
    "replay": _Verb("Analyse", "analyse.replay:replay"),
    "compare": _Verb("Analyse", "analyse.compare:compare"),
    "audit": _Verb("Analyse", "analyse.audit:audit"),
    "diagnose": _Verb("Analyse", "analyse.diagnose:diagnose"),
    "health": _Verb("Analyse", "analyse.health:health"),
    "tune": _Verb("Tune", "tune:tune"),
    "sweep": _Verb("Tune", "runs.sweep:sweep"),
    "safe": _Verb("Rig", "rig.safe:safe"),
    "doctor": _Verb("Rig", "rig.doctor:doctor"),
    "reproduce": _Verb("Other", "reproduce:reproduce"),
    "manual": _Verb("Other", "manual:manual"),
    # A negative position is an argument, not an option: goto -1mm.
    "goto": _Verb("Daemon", "daemon.goto:goto", {"ignore_unknown_options": True}),
    "set": _Verb("Daemon", "daemon.set_keys:set_keys"),
    "gains": _Verb("Daemon", "daemon.gains:gains_app"),
    "calibrate": _Verb("Rig", "rig.calibrate:calibrate_app"),
    "log": _Verb("Logs", "logs.log_verbs:log_app"),
    "runs": _Verb("Logs", "runs.runs:runs_app"),
    "plant": _Verb("Analyse", "plant:plant_app"),
    "config": _Verb("Other", "config:config_app"),
}
Verbs.panels = ("Run", "Daemon", "Analyse", "Tune", "Rig", "Logs", "Other")


def find_verb(arguments: Sequence[str]) -> str | None:
    """Return the verb that the arguments begin with; None where help or advice is due."""
    return arguments[0] if arguments and arguments[0] in _VERBS else None


@cache
def build_app(only: str | None = None) -> typer.Typer:
    """Build the command line; with `only` that verb alone, which starts in two thirds of the time.

    The help, the completion and the advice about an unknown verb need all of them.
    """
    app = typer.Typer(
        name="pamctl",
        cls=Verbs,
        no_args_is_help=True,
        epilog="\n\n".join(_list_epilog()) if only is None else None,
        pretty_exceptions_show_locals=False,
        help="Real-time controller daemon of a pneumatic artificial muscle (PAM) rig.",
    )
    app.callback()(_take_options)
    for name in _VERBS if only is None else (only,):
        panel, place, context = _VERBS[name]
        module, _, attribute = place.partition(":")
        found = getattr(import_module(f"pamctl.cli.{module}"), attribute)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name, rich_help_panel=panel)
        else:
            app.command(name, rich_help_panel=panel, context_settings=dict(context))(found)
    return app


def __getattr__(name: str) -> typer.Typer:
    """Give `app` with all verbs, built at its first use."""
    if name == "app":
        return build_app()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _list_epilog() -> list[str]:
    return [
        "First: `pamctl run --fast`, then `pamctl report LOG`. Every verb has `--help` with "
        "examples, and `pamctl manual` lists the pages. `pamctl --install-completion` lets the "
        "shell complete verbs and options.",
        "Exit codes: 0 ok, 1 unexpected, 2 wrong usage, 3 a check failed or data were lost, "
        "4 safety trip, 5 too many missed ticks, 65 bad data, 69 device or daemon unavailable, "
        "78 bad configuration, 130 and 143 ended by a signal.",
        *(f"{section.capitalize()}s: {', '.join(list_shipped(section))}" for section in SECTIONS),
    ]


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pamctl {__version__}")
        raise typer.Exit


def _take_options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit"
        ),
    ] = False,
) -> None:
    """Real-time controller daemon of a pneumatic artificial muscle (PAM) rig."""
