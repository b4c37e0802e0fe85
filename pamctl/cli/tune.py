"""`pamctl tune`: gains for a law, for one plant or for an ensemble of plants."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.options import (
    NO_CHANGES,
    ClusterOption,
    ControllerFromOption,
    JsonOption,
    require_one_place,
)
from pamctl.cli.output import print_json, print_result
from pamctl.cli.settings_from_options import resolve_options
from pamctl.exit_codes import ExitCode
from pamctl.settings.resolve import settings_to_data

if TYPE_CHECKING:
    from pamctl.tune.gains_search import BestGains
    from pamctl.tune.tune_gains import FoundGains, TuningTask


def tune(
    law: Annotated[
        str | None,
        typer.Option(
            "--law",
            metavar="NAME",
            help="Control law to tune",
            show_default="with --check: that of the gains",
        ),
    ] = None,
    controller_from: ControllerFromOption = None,
    plants: Annotated[
        list[str] | None,
        typer.Option(
            "--plant",
            metavar="NAME|FILE",
            help="Plant to tune for; can be repeated. With --ensemble, the named plants count as "
            "much as all drawn ones",
            show_default="drawn plants only",
        ),
    ] = None,
    experiment: Annotated[
        str | None,
        typer.Option(
            "--experiment",
            metavar="NAME|FILE",
            help="Motion to tune for, such as a table of your own",
            show_default="the paper's two",
        ),
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option(
            "--rig",
            metavar="NAME|FILE",
            help="Rig file whose rate, limits and calibration the simulation has",
            show_default="sim",
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Setting of rig or experiment to change, such as rig.loop.rate_hz=500; can be "
            "repeated",
            show_default=NO_CHANGES,
        ),
    ] = None,
    compensate: Annotated[
        list[str] | None,
        typer.Option(
            "--compensate",
            metavar="EFFECT",
            help="Undo this effect of the plant file around the law, and say so in the gains; "
            "can be repeated",
            show_default="nothing",
        ),
    ] = None,
    size: Annotated[
        int | None,
        typer.Option(
            "--ensemble",
            metavar="N",
            min=2,
            max=1000,
            help="Number of drawn plants in the ensemble",
            show_default="16, with --plant none",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Seed of drawn plants and search")
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="GAINS.yaml",
            help="New file for the gains",
            show_default="required, except with --check",
        ),
    ] = None,
    generations: Annotated[
        int,
        typer.Option(
            "--generations", metavar="N", min=1, max=100_000, help="Number of search generations"
        ),
    ] = 40,
    held_out: Annotated[
        int | None,
        typer.Option(
            "--held-out",
            metavar="N",
            min=1,
            max=10_000,
            help="Number of fresh plants to score on",
            show_default="200; none with --plant alone",
        ),
    ] = None,
    check: Annotated[
        str | None,
        typer.Option(
            "--check",
            metavar="GAINS",
            help="Score these gains on fresh plants, and search nothing",
            show_default="search",
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            "--start",
            metavar="GAINS",
            help="Gains to start the search from",
            show_default="the usual ones",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", metavar="N", min=1, help="Number of worker processes", show_default="all CPUs"
        ),
    ] = None,
    cluster: ClusterOption = None,
    as_json: JsonOption = False,
) -> None:
    """Search gains by simulation, or score given ones; Ctrl-C keeps the best so far."""
    from pamctl.report.report import format_terminal
    from pamctl.settings.resolve import use_law_file
    from pamctl.tune.tune_gains import (
        TuningTask,
        check_gains,
        make_scores_document,
        report_gains,
        search_gains,
    )

    require_one_place(cluster, jobs)
    if check is not None and out is not None:
        message = "belongs to a search: with --check nothing is written"
        raise typer.BadParameter(message, param_hint="--out")
    for override in overrides or ():
        if not override.startswith(("rig.", "experiment.")):
            message = f"{override}: changes settings of rig.* and experiment.* here"
            raise typer.BadParameter(message, param_hint="--set")
    if controller_from is not None:
        file_law = use_law_file(controller_from)
        law = file_law if law is None and check is None else law
    base = None
    if experiment or rig or overrides:
        plant = plants[0] if plants else None
        # The gains that are judged come later: these only have to fit a slow rig.
        slow = ["controller.lpf1_hz=1", "controller.lpf2_hz=0.5", *(overrides or ())]
        asked = resolve_options(None, rig, slow, experiment=experiment, plant=plant)
        base = asked.settings
    own_motion = experiment is not None or any(
        override.startswith("experiment.") for override in overrides or ()
    )
    task = TuningTask.of(
        law,
        plants or [],
        size,
        seed,
        held_out,
        out,
        check,
        start,
        compensate or [],
        base,
        own_motion,
    )
    if task.checked is not None:
        scores = check_gains(task, jobs, cluster)
        if as_json:
            document = make_scores_document(scores)
            gains = settings_to_data(task.checked)
            print_json({"law": task.law, "gains": gains, "scores": document})
        else:
            typer.echo(format_terminal(report_gains(task, scores)))
        return
    command = f"pamctl {shlex.join(sys.argv[1:])}"

    def show_progress(best: BestGains, took_s: float) -> None:
        if not sys.stderr.isatty():  # there the line that is rewritten says it
            line = f"generation {best.generation} of {generations}: {best.cost:.3f}, {took_s:.0f} s"
            print(line, file=sys.stderr, flush=True)

    found = search_gains(task, jobs, generations, command, show_progress, cluster)
    _print_result(task, found, as_json=as_json)
    raise typer.Exit(found.ending)


def _print_result(task: TuningTask, found: FoundGains, *, as_json: bool) -> None:
    from pamctl.report.report import format_terminal
    from pamctl.tune.tune_gains import make_scores_document, report_gains

    failure = found.failure
    document = {
        "law": task.law,
        "gains": found.best.gains,
        "cost": found.best.cost,
        "generations": found.best.generation,
        "runs": found.best.evaluations,
        "took_s": found.took_s,
        "interrupted": found.ending != ExitCode.OK,
        "scores": make_scores_document(found.scores),
        "out": None if failure else str(task.out),
    }
    if found.ending != ExitCode.OK and not failure:
        print(f"interrupted; --start {task.out} goes on from these gains", file=sys.stderr)

    def format_found() -> str:
        scores = format_terminal(report_gains(task, found.scores))
        # The search took minutes: where the file cannot be written, its text is printed.
        return f"{scores}\n{found.text.rstrip() if failure else f'gains: {task.out}'}"

    print_result(document, format_found, failure, as_json=as_json)
