"""`pamctl runs`: find runs again."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json
from pamctl.cli.runs.annotate import note_logs, tag_logs, untag_logs
from pamctl.plain_text import escape_name

runs_app = typer.Typer(
    invoke_without_command=True, help="Find runs again by law, date, error, tag or setting."
)
LogsOption = Annotated[
    Path, typer.Option("--logs", metavar="DIRECTORY", help="Directory with the logs")
]
_ANY = "any"


def _text_option(name: str, metavar: str, help_text: str) -> typer.models.OptionInfo:
    option: typer.models.OptionInfo = typer.Option(
        name, metavar=metavar, help=help_text, show_default=_ANY
    )
    return option


@runs_app.callback()
def list_runs(
    context: typer.Context,
    logs: LogsOption = Path("logs"),
    tags: Annotated[
        list[str] | None, _text_option("--tag", "TAG", "Tag; can be repeated, all must be there")
    ] = None,
    where: Annotated[
        list[str] | None,
        _text_option(
            "--where",
            "CONDITION",
            "Condition, such as law=qsmc, 'rms_um<20' or 'controller.lambda_per_s>=40'; in a text "
            "* stands for any part; can be repeated",
        ),
    ] = None,
    since: Annotated[
        str | None,
        _text_option("--since", "DATE", "First day or time, 2026-11-20 or '2026-11-20 14:30'"),
    ] = None,
    last: Annotated[
        int | None,
        typer.Option("--last", metavar="N", min=1, help="Only the newest N", show_default="all"),
    ] = None,
    paths_only: Annotated[
        bool, typer.Option("--paths", help="Print paths only, for other commands")
    ] = False,
    as_csv: Annotated[
        bool, typer.Option("--csv", help="Print CSV, with the settings that differ")
    ] = False,
    rebuild: Annotated[
        bool, typer.Option("--rebuild", help="Make the index anew from all logs")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """List the runs of a folder of logs, the newest last; all conditions must hold."""
    if context.invoked_subcommand is not None:
        return
    if as_json + as_csv + paths_only > 1:
        raise typer.BadParameter("only one of --json, --csv and --paths")
    from pamctl.runs.run_index import RunIndex
    from pamctl.runs.run_list import RunFilter, read_date, select_runs

    since_s = None if since is None else read_date(since)
    wanted = RunFilter(tags or (), since_s, where or (), last)
    with RunIndex(logs) as index:
        index.refresh(_show_progress, rebuild=rebuild)
        rows = select_runs(index, wanted, with_gains=as_csv or as_json)
        total = index.count()
    rows = [replace(row, path=escape_name(row.path)) for row in rows]
    from pamctl.runs.run_list import format_csv, format_runs, list_documents

    if paths_only:
        typer.echo("\n".join(str(logs / row.path) for row in rows), nl=bool(rows))
    elif as_csv:
        typer.echo(format_csv(rows))
    elif as_json:
        print_json({"logs": str(logs), "runs": list_documents(rows), "of": total})
    else:
        typer.echo(format_runs(rows, total))


def _show_progress(done: int, of: int) -> None:
    """Show on a terminal that logs are read, where that takes long."""
    if of > 20 and sys.stderr.isatty():
        end = "\n" if done == of else ""
        print(f"\rreading logs: {done} of {of}", end=end, file=sys.stderr, flush=True)


runs_app.command("tag")(tag_logs)
runs_app.command("untag")(untag_logs)
runs_app.command("note")(note_logs)
