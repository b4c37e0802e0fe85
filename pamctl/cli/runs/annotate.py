"""`pamctl runs tag`, `untag` and `note`: say something of runs, in their logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json

if TYPE_CHECKING:
    from pamctl.log.annotation import Annotation

_Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", help="Finished logs")]


def tag_logs(
    tag: Annotated[str, typer.Argument(metavar="TAG", help="One word, such as good")],
    paths: _Logs,
    as_json: JsonOption = False,
) -> None:
    """Add a tag to logs; `pamctl daemon --keep` never removes a tagged log."""
    _edit(paths, lambda said: said.add_tag(tag), as_json=as_json)


def untag_logs(
    tag: Annotated[str, typer.Argument(metavar="TAG", help="Tag to take away")],
    paths: _Logs,
    as_json: JsonOption = False,
) -> None:
    """Take a tag away from logs."""
    from pamctl.log.annotation import check_tag

    known = check_tag(tag)
    _edit(paths, lambda said: said.drop_tag(known), as_json=as_json)


def note_logs(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="Note; empty takes it away")],
    paths: _Logs,
    as_json: JsonOption = False,
) -> None:
    """Write a note into logs, in the place of the one before."""
    from pamctl.log.annotation import make_annotation

    note = make_annotation(note=text).note
    _edit(paths, lambda said: replace(said, note=note), as_json=as_json)


def _edit(paths: list[Path], edit: Callable[[Annotation], Annotation], *, as_json: bool) -> None:
    from pamctl.runs.run_index import edit_annotations

    done = edit_annotations(paths, edit)
    if as_json:
        print_json([{"log": str(path), **asdict(said)} for path, said in done])
    else:
        lines = (f"{path}  [{' '.join(said.tags)}]  {said.note}".rstrip() for path, said in done)
        typer.echo("\n".join(lines))
