"""`pamctl log`: the verbs for log files."""

from __future__ import annotations

import typer

from pamctl.cli.logs.check import check_logs
from pamctl.cli.logs.cut import cut_file
from pamctl.cli.logs.export import export_log
from pamctl.cli.logs.import_file import import_file
from pamctl.cli.logs.info import show_info
from pamctl.cli.logs.recover import recover_log

log_app = typer.Typer(
    no_args_is_help=True, help="Look into logs, mend, cut, export and import them."
)
log_app.command("info")(show_info)
log_app.command("check")(check_logs)
log_app.command("recover")(recover_log)
log_app.command("export")(export_log)
log_app.command("cut")(cut_file)
log_app.command("import")(import_file)
