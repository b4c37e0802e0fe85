"""`pamctl tune`, gains by simulation; `pamctl sweep`, every combination of some settings."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pamctl.cli.failure import print_error
from pamctl.cli.options import (
    CLUSTER,
    CONTROLLER_FROM,
    JOBS,
    LOGS,
    NO_CHANGES,
    AnnotationOptions,
    Options,
    flag,
    option,
    require_linux,
    require_one_place,
    verb,
)
from pamctl.cli.output import PAGE_BEGIN, print_report, tell
from pamctl.cli.settings_from_options import SettingsOptions, resolve_options
from pamctl.exit_codes import ExitCode
from pamctl.log.run_meta import file_safe_name
from pamctl.new_file import require_folder, write_files

if TYPE_CHECKING:
    from pamctl.session.run_sweep import SweepEnd, SweepPlan


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


# --- sweep ------------------------------------------------------------------------------------


class SweepOptions(SettingsOptions, AnnotationOptions):
    """`pamctl sweep`."""

    overrides: list[str] = option(
        "--set KEY=VALUE,...",
        "Setting to sweep, such as controller.lambda_per_s=20,40,80; with one value it is the "
        "same in all runs; can be repeated",
        ...,
    )
    repeats: int = option("--repeat N", "Runs of each combination", 1, low=1, high=1000)
    name: str | None = option(
        "--name NAME",
        "Name of the sweep and tag of its logs; the name of an earlier one continues it",
        shown="sweep-DATE",
    )
    logs: Path = LOGS
    by_daemon: bool = flag("--daemon", "Gone: steer the daemon from Python instead")
    quiet: bool = flag("--quiet", "Print no progress")


@verb
def sweep(asked: SweepOptions) -> None:
    """Run every combination of some settings, repeated; write a table and a page beside the logs.

    An interrupted sweep keeps its logs and goes on with the same command and --name.
    """
    from pamctl.session.run_sweep import OwnRunner, parse_sweep, require_end, run_sweep

    said = asked.make_annotation()
    title = asked.name or datetime.now().strftime("sweep-%Y%m%d-%H%M%S")
    if file_safe_name(title) != title:
        allowed = "letters, digits and . _ - only, 60 at most"
        raise typer.BadParameter(f"{title!r}: {allowed}", param_hint="--name")
    request = parse_sweep(asked.overrides, asked.repeats)
    silent = asked.quiet or asked.as_json
    tell_run: Callable[[str], object] = (lambda line: None) if silent else tell
    if asked.by_daemon:
        fix = "from Python, set each gain and run: `pamctl manual find-runs-again`"
        raise typer.BadParameter(f"a sweep makes runs of its own; {fix}", param_hint="--daemon")
    base, names = asked.resolve_with(request.fixed)
    # Every point is checked before the first run.
    points = [asked.resolve_with(whole).settings for whole in request.list_overrides()]
    for settings in points:
        require_end(settings)
    require_linux()
    require_folder(asked.logs)
    asked.logs.mkdir(parents=True, exist_ok=True)
    runner = OwnRunner(points, names, asked.logs, not silent)
    plan = runner.plan_sweep(base, request, asked.repeats, title, said)
    end = run_sweep(plan, runner, tell_run)
    _conclude(plan, end, as_json=asked.as_json)


def _conclude(plan: SweepPlan, end: SweepEnd, *, as_json: bool) -> None:
    from pamctl.report.report import Report
    from pamctl.session.sweep_result import (
        format_points_csv,
        list_point_documents,
        summarise_points,
        tabulate_points,
    )

    points = summarise_points(end.rows)
    saved: dict[str, str | None] = {"page": None, "csv": None}
    if points:
        from pamctl.report.html_page import write_html
        from pamctl.runs.run_row import find_varying_keys
        from pamctl.session.sweep_result import write_sweep_page

        keys = [key for key in points[0].point if key in find_varying_keys(end.rows)]
        page = write_html(write_sweep_page(plan.name, plan.folder, end.rows, keys))
        table = format_points_csv(points)
        targets = {name: plan.folder / f"{plan.name}.{name}" for name in ("html", "csv")}
        write_files({targets["html"]: page}, replaces=PAGE_BEGIN)
        write_files({targets["csv"]: table}, replaces=table.partition("\n")[0])
        saved = {"page": str(targets["html"]), "csv": str(targets["csv"])}
    document = {
        "exit_code": int(end.ending.code),
        "reason": end.ending.reason,
        "sweep": plan.name,
        "logs": str(plan.folder),
        "left": end.left,
        **saved,
        "points": list_point_documents(points),
    }
    if points or as_json:
        said = f"{len(end.rows)} runs, mean ± standard deviation of those that ended well"
        report = Report(f"Sweep {plan.name}", said, document=document)
        report.add(*[tabulate_points(points)] * bool(points))
        files = f"\n\npage: {saved['page']}\ntable: {saved['csv']}"
        print_report(report, as_json=as_json, end=files)
    if not end.ending.code:
        return
    print_error(end.ending.reason)
    if end.left and not as_json:
        tell(f"{end.left} runs are left: the same command with --name {plan.name}")
    raise typer.Exit(end.ending.code)
