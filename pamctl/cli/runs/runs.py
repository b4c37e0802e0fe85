"""`pamctl runs`: find runs again."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import PAGE_BEGIN, print_json
from pamctl.cli.runs.annotate import note_logs, tag_logs, untag_logs
from pamctl.new_file import require_place, write_files
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
    law: Annotated[
        str | None, _text_option("--law", "NAME", "Name of the law; * stands for any part")
    ] = None,
    controller: Annotated[
        str | None, _text_option("--controller", "NAME", "Name of the gains file")
    ] = None,
    experiment: Annotated[
        str | None, _text_option("--experiment", "NAME", "Name of the experiment")
    ] = None,
    plant: Annotated[str | None, _text_option("--plant", "NAME", "Name of the plant file")] = None,
    backend: Annotated[str | None, _text_option("--backend", "NAME", "Name of the backend")] = None,
    operator: Annotated[
        str | None, _text_option("--operator", "NAME", "Name of the operator")
    ] = None,
    sample: Annotated[str | None, _text_option("--sample", "NAME", "Name of the sample")] = None,
    since: Annotated[
        str | None,
        _text_option("--since", "DATE", "First day or time, such as monday or '2 days ago'"),
    ] = None,
    until: Annotated[
        str | None, _text_option("--until", "DATE", "Last day or time; a day counts whole")
    ] = None,
    max_error_um: Annotated[
        str | None,
        _text_option("--max-error-um", "LIMIT", "Largest error, such as '>50' or 10..20"),
    ] = None,
    rms_um: Annotated[
        str | None, _text_option("--rms-um", "LIMIT", "RMS error, such as '<20'")
    ] = None,
    steady_um: Annotated[
        str | None, _text_option("--steady-um", "LIMIT", "Steady-state error, such as '<15'")
    ] = None,
    ending: Annotated[
        str | None,
        _text_option(
            "--ending",
            "WORD|CODE",
            "Word such as ok, trip, estop, overruns, stopped, failed or unfinished, or a code",
        ),
    ] = None,
    verdict: Annotated[
        str | None,
        _text_option("--verdict", "TEXT", "Part of a safety rule that clipped or tripped"),
    ] = None,
    tags: Annotated[
        list[str] | None, _text_option("--tag", "TAG", "Tag; can be repeated, all must be there")
    ] = None,
    without_tags: Annotated[
        list[str] | None,
        _text_option("--without-tag", "TAG", "Tag that a run must not have"),
    ] = None,
    note_text: Annotated[
        str | None, _text_option("--note-text", "TEXT", "Part of the note, or of a mark")
    ] = None,
    where: Annotated[
        list[str] | None,
        _text_option(
            "--where",
            "CONDITION",
            "Condition, such as 'controller.lambda_per_s>=40'; can be repeated",
        ),
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
    page: Annotated[
        Path | None,
        typer.Option(
            "--page",
            metavar="FILE.html",
            help="Page with errors against settings to write",
            show_default="no page",
        ),
    ] = None,
    against: Annotated[
        list[str] | None,
        typer.Option(
            "--against",
            metavar="KEY",
            help="Setting on the page, such as controller.lambda_per_s; can be repeated",
            show_default="those that differ",
        ),
    ] = None,
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
    if page is not None:
        require_place(page, replaces=PAGE_BEGIN)
    from pamctl.runs.run_filter import RunFilter, select_runs
    from pamctl.runs.run_index import RunIndex
    from pamctl.runs.spoken_dates import parse_date

    limits = {"max_um": max_error_um, "rms_um": rms_um, "steady_um": steady_um}
    wanted = RunFilter(
        law=law,
        controller=controller,
        experiment=experiment,
        plant=plant,
        backend=backend,
        operator=operator,
        sample=sample,
        ending=ending,
        verdict=verdict,
        note_text=note_text,
        tags=tags or (),
        without_tags=without_tags or (),
        since=None if since is None else parse_date(since),
        until=None if until is None else parse_date(until),
        limits=[(name, limit) for name, limit in limits.items() if limit is not None],
        where=where or (),
        last=last,
    )
    with RunIndex(logs) as index:
        index.refresh(_show_progress, rebuild=rebuild)
        with_gains = bool(as_csv or as_json or page)
        rows, total = select_runs(index, wanted, with_gains=with_gains), index.count()
    rows = [replace(row, path=escape_name(row.path)) for row in rows]
    from pamctl.runs.runs_text import format_csv, format_runs, list_documents

    if page is not None:
        from pamctl.runs.runs_page import write_runs_page

        html = write_runs_page("Runs", logs, rows, against or ()).html()
        write_files({page: html}, replaces=PAGE_BEGIN)
    if paths_only:
        typer.echo("\n".join(str(logs / row.path) for row in rows), nl=bool(rows))
    elif as_csv:
        typer.echo(format_csv(rows))
    elif as_json:
        saved = None if page is None else str(page)
        print_json({"logs": str(logs), "page": saved, "runs": list_documents(rows), "of": total})
    else:
        typer.echo(format_runs(rows, total) + (f"\npage: {page}" if page else ""))


def _show_progress(done: int, of: int) -> None:
    """Show on a terminal that logs are read, where that takes long."""
    if of > 20 and sys.stderr.isatty():
        end = "\n" if done == of else ""
        print(f"\rreading logs: {done} of {of}", end=end, file=sys.stderr, flush=True)


runs_app.command("tag")(tag_logs)
runs_app.command("untag")(untag_logs)
runs_app.command("note")(note_logs)
