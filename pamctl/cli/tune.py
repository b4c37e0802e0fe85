"""`pamctl tune`: gains by simulation."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import typer

from pamctl.base.errors import ExitCode
from pamctl.cli.options import (
    CLUSTER,
    CONTROLLER_FROM,
    JOBS,
    NO_CHANGES,
    Options,
    option,
    require_one_place,
    verb,
)
from pamctl.cli.output import print_report
from pamctl.cli.settings_from_options import resolve_options


class TuneOptions(Options):
    """`pamctl tune`."""

    law: str | None = option(
        "--law NAME", "Control law to tune", shown="pid; with --check: that of the gains"
    )
    controller_from: str | None = CONTROLLER_FROM
    plants: list[str] = option(
        "--plant NAME|FILE",
        "Plant to tune for; can be repeated. With --ensemble, the named plants count as "
        "much as all drawn ones",
        shown="drawn plants only",
    )
    experiment: str | None = option(
        "--experiment NAME|FILE",
        "Motion to tune for, such as a table of your own",
        shown="the paper's two",
    )
    rig: str | None = option(
        "--rig NAME|FILE",
        "Rig file whose rate, limits and calibration the simulation has",
        shown="sim",
    )
    overrides: list[str] = option(
        "--set KEY=VALUE",
        "Setting of rig or experiment to change, such as rig.loop.rate_hz=500; can be repeated",
        shown=NO_CHANGES,
    )
    compensate: list[str] = option(
        "--compensate EFFECT",
        "Undo this effect of the plant file around the law, and say so in the gains; "
        "can be repeated",
        shown="nothing",
    )
    size: int | None = option(
        "--ensemble N",
        "Number of drawn plants in the ensemble; with --check, of fresh plants to score on",
        shown="16, of fresh ones 200; with --plant none",
        low=2,
        high=1000,
    )
    seed: int = option("--seed N", "Seed of drawn plants and search", 0, low=0)
    out: Path | None = option(
        "--out GAINS.yaml", "New file for the gains", shown="gains.yaml; with --check none"
    )
    generations: int = option(
        "--generations N", "Number of search generations", 40, low=1, high=100_000
    )
    check: str | None = option(
        "--check GAINS", "Score these gains on fresh plants, and search nothing", shown="search"
    )
    start: str | None = option(
        "--start GAINS", "Gains to start the search from", shown="the usual ones"
    )
    jobs: int | None = JOBS
    cluster: str | None = CLUSTER


@verb
def tune(asked: TuneOptions) -> None:
    """Search gains by simulation, or score given ones; Ctrl-C keeps the best so far."""
    from pamctl.settings.resolve import settings_to_data, use_law_file
    from pamctl.tune.tune_gains import TuningTask, check_gains, report_gains, search_gains

    require_one_place(asked.cluster, asked.jobs)
    if asked.check is not None and asked.out is not None:
        message = "belongs to a search: with --check nothing is written"
        raise typer.BadParameter(message, param_hint="--out")
    for override in asked.overrides:
        if not override.startswith(("rig.", "experiment.")):
            message = f"{override}: changes settings of rig.* and experiment.* here"
            raise typer.BadParameter(message, param_hint="--set")
    file_law = "pid" if asked.controller_from is None else use_law_file(asked.controller_from)
    if asked.check is None:
        asked.law = asked.law or file_law
        asked.out = asked.out or Path("gains.yaml")
    base = None
    if asked.experiment or asked.rig or asked.overrides:
        first = asked.plants[0] if asked.plants else None
        # The gains that are judged come later: these only have to fit a slow rig.
        slow = ["controller.lpf1_hz=1", "controller.lpf2_hz=0.5", *(asked.overrides)]
        resolved = resolve_options(None, asked.rig, slow, experiment=asked.experiment, plant=first)
        base = resolved.settings
    own_motion = asked.experiment is not None or any(
        override.startswith("experiment.") for override in asked.overrides
    )
    task = TuningTask.of(asked, base, own_motion=own_motion)
    if task.checked is not None:
        scores = check_gains(task, asked.jobs, asked.cluster)
        said = report_gains(task, scores, {"gains": settings_to_data(task.checked)})
        print_report(said, as_json=asked.as_json)
        return
    command = f"pamctl {shlex.join(sys.argv[1:])}"
    found = search_gains(task, asked.jobs, asked.generations, command, asked.cluster)
    failure = found.failure
    document = {
        "gains": found.best.gains,
        "cost": found.best.cost,
        "generations": found.best.generation,
        "runs": found.best.evaluations,
        "took_s": found.took_s,
        "interrupted": found.ending != ExitCode.OK,
        "out": None if failure else str(task.out),
    }
    if found.ending != ExitCode.OK and not failure:
        print(f"interrupted; --start {task.out} goes on from these gains", file=sys.stderr)
    # The search took minutes: where the file cannot be written, its text is printed.
    end = found.text.rstrip() if failure else f"gains: {task.out}"
    said = report_gains(task, found.scores, document)
    print_report(said, as_json=asked.as_json, failure=failure, end=f"\n{end}")
    raise typer.Exit(found.ending)
