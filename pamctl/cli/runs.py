"""`pamctl runs`: find runs again, and say something of them in their logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pamctl.base.texts import escape_name
from pamctl.cli.options import LOGS, Options, argument, flag, option, verb
from pamctl.cli.output import print_json, print_report

if TYPE_CHECKING:
    from pamctl.log.run_meta import Annotation

runs_app = typer.Typer(
    invoke_without_command=True, help="Find runs again by law, date, error, tag or setting."
)
_ANY = "any"


class RunsOptions(Options):
    """`pamctl runs`."""

    logs: Path = LOGS
    tags: list[str] = option("--tag TAG", "Tag; can be repeated, all must be there", shown=_ANY)
    where: list[str] = option(
        "--where CONDITION",
        "Condition, such as law=qsmc, 'rms_um<20' or 'controller.lambda_per_s>=40'; in a text "
        "* stands for any part; can be repeated",
        shown=_ANY,
    )
    since: str | None = option(
        "--since DATE", "First day or time, 2026-11-20 or '2026-11-20 14:30'", shown=_ANY
    )
    last: int | None = option("--last N", "Only the newest N", shown="all", low=1)
    paths_only: bool = flag("--paths", "Print paths only, for other commands")
    as_csv: bool = flag("--csv", "Print CSV, with the settings that differ")
    rebuild: bool = flag("--rebuild", "Make the index anew from all logs")


@runs_app.callback()
@verb
def list_runs(asked: RunsOptions) -> None:
    """List the runs of a folder of logs, the newest last; all conditions must hold."""
    if asked.inner_verb is not None:
        return
    if asked.as_json + asked.as_csv + asked.paths_only > 1:
        raise typer.BadParameter("only one of --json, --csv and --paths")
    from pamctl.report.progress_line import WorkProgress
    from pamctl.runs.run_index import (
        RunFilter,
        RunIndex,
        format_csv,
        read_date,
        report_runs,
        select_runs,
    )

    since_s = None if asked.since is None else read_date(asked.since)
    wanted = RunFilter(asked.tags, since_s, asked.where, asked.last)
    index = RunIndex(asked.logs)
    with WorkProgress("runs") as progress:
        show = partial(progress, saying="reading logs")
        index.refresh(show, rebuild=asked.rebuild)
    rows, total = select_runs(index, wanted), index.count()
    rows = [replace(row, path=escape_name(row.path)) for row in rows]
    if asked.paths_only:
        typer.echo("\n".join(str(asked.logs / row.path) for row in rows), nl=bool(rows))
    elif asked.as_csv:
        typer.echo(format_csv(rows))
    else:
        print_report(report_runs(rows, total, asked.logs), as_json=asked.as_json)


# --- annotations ------------------------------------------------------------------------------


class TagOptions(Options):
    """`pamctl runs tag` and `pamctl runs untag`."""

    tag: str = argument("TAG", "One word, such as good")
    paths: list[Path] = argument("LOG...", "Finished logs")


@runs_app.command("tag")
@verb
def tag_logs(asked: TagOptions) -> None:
    """Add a tag to logs; `pamctl daemon --keep` never removes a tagged log."""
    _edit(asked.paths, lambda said: said.add_tag(asked.tag), as_json=asked.as_json)


@runs_app.command("untag")
@verb
def untag_logs(asked: TagOptions) -> None:
    """Take a tag away from logs."""
    from pamctl.log.run_meta import check_tag

    known = check_tag(asked.tag)
    _edit(asked.paths, lambda said: said.drop_tag(known), as_json=asked.as_json)


class NoteOptions(Options):
    """`pamctl runs note`."""

    text: str = argument("TEXT", "Note; empty takes it away")
    paths: list[Path] = argument("LOG...", "Finished logs")


@runs_app.command("note")
@verb
def note_logs(asked: NoteOptions) -> None:
    """Write a note into logs, in the place of the one before."""
    from pamctl.log.run_meta import make_annotation

    note = make_annotation(note=asked.text).note
    _edit(asked.paths, lambda said: replace(said, note=note), as_json=asked.as_json)


def _edit(paths: list[Path], edit: Callable[[Annotation], Annotation], *, as_json: bool) -> None:
    from pamctl.runs.run_index import edit_annotations

    done = edit_annotations(paths, edit)
    if as_json:
        print_json([{"log": str(path), **asdict(said)} for path, said in done])
    else:
        lines = (f"{path}  [{' '.join(said.tags)}]  {said.note}".rstrip() for path, said in done)
        typer.echo("\n".join(lines))
