"""The command line: `pamctl VERB`, with its verbs in groups."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from pamctl import __version__
from pamctl.cli.analyse.audit import audit
from pamctl.cli.analyse.compare import compare
from pamctl.cli.analyse.diagnose import diagnose
from pamctl.cli.analyse.health import health
from pamctl.cli.analyse.replay import replay
from pamctl.cli.analyse.report import report
from pamctl.cli.config import config_app
from pamctl.cli.daemon.ack import ack
from pamctl.cli.daemon.daemon import daemon
from pamctl.cli.daemon.disarm import disarm
from pamctl.cli.daemon.estop import estop
from pamctl.cli.daemon.gains import gains_app
from pamctl.cli.daemon.goto import goto
from pamctl.cli.daemon.mark import mark
from pamctl.cli.daemon.set_keys import set_keys
from pamctl.cli.daemon.start import start
from pamctl.cli.daemon.status import status
from pamctl.cli.daemon.stop import stop
from pamctl.cli.daemon.watch import watch
from pamctl.cli.failure import Verbs
from pamctl.cli.logs.check import check_logs
from pamctl.cli.logs.cut import cut_file
from pamctl.cli.logs.export import export_log
from pamctl.cli.logs.import_file import import_file
from pamctl.cli.logs.info import show_info
from pamctl.cli.logs.recover import recover_log
from pamctl.cli.manual import manual
from pamctl.cli.plant import plant_app
from pamctl.cli.reproduce import reproduce
from pamctl.cli.rig.calibrate import calibrate_app
from pamctl.cli.rig.doctor import doctor
from pamctl.cli.rig.run import run
from pamctl.cli.rig.safe import safe
from pamctl.cli.runs.runs import runs_app
from pamctl.cli.runs.sweep import sweep
from pamctl.cli.tune import tune
from pamctl.settings.resolve import SECTIONS, list_shipped

_EPILOG = (
    "First: `pamctl run --fast`, then `pamctl report LOG`. Every verb has `--help` with examples, "
    "and `pamctl manual` lists the pages. `pamctl --install-completion` lets the shell complete "
    "verbs and options.",
    "Exit codes: 0 ok, 1 unexpected, 2 wrong usage, 3 a check failed or data were lost, 4 safety "
    "trip, 5 too many missed ticks, 65 bad data, 69 device or daemon unavailable, 78 bad "
    "configuration, 130 and 143 ended by a signal.",
    *(f"{section.capitalize()}s: {', '.join(list_shipped(section))}" for section in SECTIONS),
)

app = typer.Typer(
    name="pamctl",
    cls=Verbs,
    no_args_is_help=True,
    epilog="\n\n".join(_EPILOG),
    pretty_exceptions_show_locals=False,
    help="Real-time controller daemon of a pneumatic artificial muscle (PAM) rig.",
)
log_app = typer.Typer(
    no_args_is_help=True, help="Look into logs, mend, cut, export and import them."
)

_GROUPS: dict[str, tuple[Callable[..., None], ...]] = {
    "Run": (run,),
    "Daemon": (daemon, status, start, stop, estop, ack, disarm, mark, watch),
    "Analyse": (report, replay, compare, audit, diagnose, health),
    "Tune": (tune, sweep),
    "Rig": (safe, doctor),
    "Logs": (),
    "Other": (reproduce, manual),
}
Verbs.panels = tuple(_GROUPS)
for panel, verbs in _GROUPS.items():
    for verb in verbs:
        app.command(rich_help_panel=panel)(verb)
# A negative position is an argument, not an option: goto -1mm.
app.command(rich_help_panel="Daemon", context_settings={"ignore_unknown_options": True})(goto)
app.command("set", rich_help_panel="Daemon")(set_keys)
app.add_typer(gains_app, name="gains", rich_help_panel="Daemon")
app.add_typer(calibrate_app, name="calibrate", rich_help_panel="Rig")
app.add_typer(log_app, name="log", rich_help_panel="Logs")
app.add_typer(runs_app, name="runs", rich_help_panel="Logs")
app.add_typer(plant_app, name="plant", rich_help_panel="Analyse")
app.add_typer(config_app, name="config", rich_help_panel="Other")
log_app.command("info")(show_info)
log_app.command("check")(check_logs)
log_app.command("recover")(recover_log)
log_app.command("export")(export_log)
log_app.command("cut")(cut_file)
log_app.command("import")(import_file)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pamctl {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit"
        ),
    ] = False,
) -> None:
    """Real-time controller daemon of a pneumatic artificial muscle (PAM) rig."""
