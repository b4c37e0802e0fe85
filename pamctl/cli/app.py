"""The command line: `pamctl VERB`, with its verbs in groups."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Annotated, Any

import typer

from pamctl import __version__
from pamctl.cli.failure import Verbs
from pamctl.cli.verbs import PANELS, VERBS
from pamctl.settings.config_files import DEFAULT_NAMES, list_shipped

Verbs.panels = PANELS


def build_asked(arguments: Sequence[str]) -> typer.Typer:
    """Build as much of the command line as the arguments need: most often one verb.

    Where they do not begin with a verb, there is help or advice, which names all verbs.
    """
    if "_PAMCTL_COMPLETE" in os.environ:  # the shell asks for the options of any verb
        return build_app()
    if arguments and arguments[0] in VERBS:
        return build_app(frozenset(arguments[:1]), names_others=False)
    return build_app(frozenset(VERBS).intersection(arguments))


@cache
def build_app(
    verbs: frozenset[str] = frozenset(VERBS), *, names_others: bool = True
) -> typer.Typer:
    """Build the command line with these verbs, and with no more than the names of the others."""
    app = typer.Typer(
        name="pamctl",
        cls=Verbs,
        no_args_is_help=True,
        epilog="\n\n".join(_list_epilog()) if names_others else None,
        pretty_exceptions_show_locals=False,
        help="Real-time controller daemon of a pneumatic artificial muscle (PAM) rig.",
    )
    app.callback()(_take_options)
    for name, verb in VERBS.items():
        if name in verbs:
            found = _import_verb(verb.place)
            if isinstance(found, typer.Typer):
                app.add_typer(found, name=name, rich_help_panel=verb.panel)
            else:
                context = dict(verb.context)
                app.command(name, rich_help_panel=verb.panel, context_settings=context)(found)
        elif names_others:
            app.command(name, rich_help_panel=verb.panel, help=verb.told)(lambda: None)
    return app


def _import_verb(place: str) -> Any:
    module, _, attribute = place.partition(":")
    return getattr(import_module(f"pamctl.cli.{module}"), attribute)


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
        "78 bad configuration, 129, 130 and 143 ended by a signal.",
        *(
            f"{section.capitalize()}s: {', '.join(list_shipped(section))}"
            for section in DEFAULT_NAMES
        ),
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
