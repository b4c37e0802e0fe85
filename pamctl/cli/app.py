"""The command line: `pamctl VERB`."""

from __future__ import annotations

from typing import Annotated

import typer

from pamctl import __version__
from pamctl.cli import steer
from pamctl.cli.audit import audit
from pamctl.cli.calibrate import calibrate_app
from pamctl.cli.compare import compare
from pamctl.cli.config import config_app
from pamctl.cli.daemon import daemon
from pamctl.cli.diagnose import diagnose
from pamctl.cli.doctor import doctor
from pamctl.cli.log import log_app
from pamctl.cli.log_export import export_log
from pamctl.cli.log_import import import_file
from pamctl.cli.replay import replay
from pamctl.cli.report import report
from pamctl.cli.reproduce import reproduce
from pamctl.cli.run import run
from pamctl.cli.safe import safe
from pamctl.cli.tune import tune
from pamctl.cli.watch import watch

app = typer.Typer(
    name="pamctl",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
    help="Controller daemon of a pneumatic artificial muscle rig.",
)
app.command()(run)
app.command()(safe)
app.command()(doctor)
app.command()(replay)
app.command()(audit)
app.command()(diagnose)
app.command()(compare)
app.command()(report)
app.command()(reproduce)
app.command()(tune)
app.command()(daemon)
for client in (steer.status, steer.start, steer.stop, steer.estop, steer.ack, steer.disarm):
    app.command()(client)
app.command()(watch)
app.command(context_settings={"ignore_unknown_options": True})(steer.goto)  # goto -1mm
app.command()(steer.mark)
app.command("set")(steer.set_keys)
app.add_typer(steer.gains_app, name="gains")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(config_app, name="config")
app.add_typer(log_app, name="log")
log_app.command("export")(export_log)
log_app.command("import")(import_file)


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
