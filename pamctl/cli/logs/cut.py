"""`pamctl log cut`: a piece of a log as a log of its own."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.options import JsonOption, seconds_option
from pamctl.cli.output import print_json
from pamctl.plain_text import escape_name

if TYPE_CHECKING:
    from pamctl.log.edit import CutLog

_WHOLE = "the whole log"


def cut_file(
    source: Annotated[Path, typer.Argument(metavar="LOG", help="Log to cut")],
    destination: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="NEW.mcap",
            help="New log; with --at-gaps NEW-1.mcap, NEW-2.mcap and so on",
        ),
    ],
    from_s: Annotated[
        float | None,
        seconds_option("--from-s", "First time, by t_s", at_least=0.0, show_default=_WHOLE),
    ] = None,
    to_s: Annotated[
        float | None,
        seconds_option(
            "--to-s", "End by t_s, itself not included", at_least=0.0, show_default=_WHOLE
        ),
    ] = None,
    from_row: Annotated[
        int | None,
        typer.Option(
            "--from-row", metavar="ROW", min=0, help="First row, from 0", show_default=_WHOLE
        ),
    ] = None,
    to_row: Annotated[
        int | None,
        typer.Option(
            "--to-row", metavar="ROW", min=0, help="End, itself not included", show_default=_WHOLE
        ),
    ] = None,
    at_gaps: Annotated[
        bool, typer.Option("--at-gaps", help="Write a file for each stretch between gaps")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a piece of a log as a new log, by time, by rows, or a file for each stretch.

    Ticks keep their numbers and times. The new log names the log that it was cut from.
    """
    limits = (from_s, to_s, from_row, to_row)
    if not at_gaps and all(limit is None for limit in limits):
        raise typer.BadParameter(
            "say what to cut: --from-s, --to-s, --from-row, --to-row or --at-gaps",
            param_hint="--out",
        )
    from pamctl.log.edit import cut_log

    done = cut_log(
        source,
        destination,
        from_s=from_s,
        to_s=to_s,
        from_row=from_row,
        to_row=to_row,
        at_gaps=at_gaps,
    )
    if as_json:
        print_json(asdict(done))
    else:
        typer.echo("\n".join(_format_cut(done)))


def _format_cut(done: CutLog) -> list[str]:
    lines = [
        f"{escape_name(piece.destination)}: {piece.last_row - piece.first_row + 1} rows, "
        f"{piece.first_row} to {piece.last_row} of {done.rows}, "
        f"{piece.from_s:.6g} to {piece.to_s:.6g} s"
        for piece in done.pieces
    ]
    if done.left_out:
        rows = ", ".join(map(str, done.left_out[:10]))
        lines.append(f"left out, alone between two gaps: row {rows}")
    return lines
