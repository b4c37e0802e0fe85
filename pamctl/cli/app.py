"""The command line: `pamctl VERB`."""

from __future__ import annotations

from typing import Annotated

import typer

from pamctl import __version__
from pamctl.cli.config import config_app
from pamctl.cli.log import log_app
from pamctl.cli.run import run
from pamctl.cli.safe import safe

app = typer.Typer(
    name="pamctl",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
    help="Controller daemon of a pneumatic artificial muscle rig.",
)
app.command()(run)
app.command()(safe)
app.add_typer(config_app, name="config")
app.add_typer(log_app, name="log")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pamctl {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    """Controller daemon of a pneumatic artificial muscle rig."""
