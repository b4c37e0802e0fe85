"""`pamctl tune`: gains for a law, for one plant or for an ensemble of plants."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.config import ControllerFromOption, JsonOption, exit_on_config_errors


def tune(
    law: Annotated[
        str | None, typer.Option("--law", metavar="NAME", help="Law whose gains are sought.")
    ] = None,
    controller_from: ControllerFromOption = None,
    plants: Annotated[
        list[str] | None,
        typer.Option(
            "--plant",
            metavar="NAME|FILE",
            help="Tune for this one; repeats. With --ensemble: these weigh as much as all drawn.",
        ),
    ] = None,
    size: Annotated[
        int | None,
        typer.Option("--ensemble", metavar="N", min=2, max=1000, help="Tune for N drawn plants."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of plants and search.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="GAINS.yaml", help="Where the gains go.")
    ] = None,
    generations: Annotated[
        int, typer.Option("--generations", min=1, max=100_000, help="Stop after so many.")
    ] = 40,
    quantile: Annotated[
        float,
        typer.Option(
            "--quantile", min=0.5, max=1.0, help="Of the drawn plants; 1: the worst one counts."
        ),
    ] = 1.0,
    held_out: Annotated[
        int, typer.Option("--held-out", min=1, max=10_000, help="Fresh plants for the score.")
    ] = 200,
    check: Annotated[
        str | None,
        typer.Option("--check", metavar="GAINS", help="Only score these gains, on fresh plants."),
    ] = None,
    start: Annotated[
        str | None, typer.Option("--start", metavar="GAINS", help="Begin beside these gains.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, help="Processes; as many as CPUs.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Seek gains by simulation, or score given ones; Ctrl-C keeps the best so far."""
    from pamctl.settings.resolve import use_law_file
    from pamctl.tune.tune_gains import (  # slow imports, for this verb
        TuningTask,
        check_gains,
        seek_gains,
    )

    if check is not None and out is not None:
        message = "belongs to a search: with --check nothing is written"
        raise typer.BadParameter(message, param_hint="--out")
    with exit_on_config_errors(as_json=as_json):
        if controller_from is not None:
            file_law = use_law_file(controller_from)
            law = file_law if law is None and check is None else law
        asked = TuningTask.of(law, plants or [], size, seed, quantile, held_out, out, check, start)
    if asked.checked is not None:
        code = check_gains(asked, jobs, as_json=as_json)
    else:
        command = f"pamctl {shlex.join(sys.argv[1:])}"
        code = seek_gains(asked, jobs, generations, command, as_json=as_json)
    raise typer.Exit(int(code))
