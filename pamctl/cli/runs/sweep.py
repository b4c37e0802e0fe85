"""`pamctl sweep`: every combination of some settings, repeated."""

from __future__ import annotations

import sys
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.backend_option import BackendOption
from pamctl.cli.failure import print_error
from pamctl.cli.options import (
    ControllerFromOption,
    ControllerOption,
    DurationOption,
    ExperimentOption,
    FastOption,
    JsonOption,
    NoteOption,
    OperatorOption,
    PlantOption,
    RigOption,
    RtOption,
    SampleOption,
    SeedOption,
    SocketOption,
    TagOption,
    require_linux,
)
from pamctl.cli.output import PAGE_BEGIN, print_json
from pamctl.cli.runs.runs import LogsOption
from pamctl.cli.settings_from_options import resolve_options
from pamctl.log.annotation import make_annotation
from pamctl.log.run_meta import file_safe_name
from pamctl.new_file import require_folder, write_files
from pamctl.settings.config_files import DEFAULT_NAMES
from pamctl.sweep.sweep_plan import parse_sweep, require_end

if TYPE_CHECKING:
    from pamctl.sweep.run_sweep import SweepEnd, SweepPlan


def sweep(
    overrides: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="KEY=VALUE,...",
            help="Setting to sweep, such as controller.lambda_per_s=20,40,80; with one value it "
            "is the same in all runs; can be repeated",
        ),
    ],
    repeats: Annotated[
        int, typer.Option("--repeat", metavar="N", min=1, max=1000, help="Runs of each combination")
    ] = 1,
    name: Annotated[
        str | None,
        typer.Option(
            "--name",
            metavar="NAME",
            help="Name of the sweep and tag of its logs; the name of an earlier one continues it",
            show_default="sweep-DATE",
        ),
    ] = None,
    logs: LogsOption = Path("logs"),
    backend: BackendOption = None,
    controller: ControllerOption = None,
    controller_from: ControllerFromOption = None,
    experiment: ExperimentOption = None,
    rig: RigOption = None,
    plant: PlantOption = None,
    duration_s: DurationOption = None,
    fast: FastOption = False,
    seed: SeedOption = None,
    rt: RtOption = None,
    by_daemon: Annotated[
        bool, typer.Option("--daemon", help="Run on the daemon; only its gains can be swept")
    ] = False,
    socket: SocketOption = None,
    note: NoteOption = None,
    operator: OperatorOption = None,
    sample: SampleOption = None,
    tags: TagOption = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print no progress")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run every combination of some settings, repeated; write a table and a page beside the logs.

    An interrupted sweep keeps its logs and goes on with the same command and --name.
    """
    said = make_annotation(tags or (), note, operator, sample)
    title = name or datetime.now().strftime("sweep-%Y%m%d-%H%M%S")
    if file_safe_name(title) != title:
        allowed = "letters, digits and . _ - only, 60 at most"
        raise typer.BadParameter(f"{title!r}: {allowed}", param_hint="--name")
    request = parse_sweep(overrides, repeats)
    tell = partial(_tell, quiet=quiet or as_json)
    if by_daemon:
        own = (backend, controller, controller_from, rig, plant, seed, rt, fast or None)
        if any(option is not None for option in own):
            raise typer.BadParameter(
                "the daemon has its own rig, plant and gains; give only --experiment, --duration "
                "and --set controller.KEY=...",
                param_hint="--daemon",
            )
        named = experiment or DEFAULT_NAMES["experiment"]
        settings, _ = resolve_options(None, None, None, experiment=named, duration_s=duration_s)
        require_end(settings)
        require_linux()
        from pamctl.daemon.client import Client, default_socket
        from pamctl.sweep.run_sweep import DaemonRunner, run_sweep

        with (
            Client(socket or default_socket()) as client,
            DaemonRunner(client, settings, file_safe_name(named)) as runner,
        ):
            plan = runner.plan_sweep(request, repeats, title, said)
            end = run_sweep(plan, runner, tell)
    else:
        choose = partial(
            resolve_options,
            backend,
            rig,
            controller=controller,
            controller_from=controller_from,
            experiment=experiment,
            plant=plant,
            seed=seed,
            duration_s=duration_s,
            fast=fast or None,
            rt=rt,
        )
        base, names = choose(overrides=request.fixed)
        # Every point is checked before the first run.
        points = [choose(overrides=whole).settings for whole in request.list_overrides()]
        for settings in points:
            require_end(settings)
        require_linux()
        require_folder(logs)
        logs.mkdir(parents=True, exist_ok=True)
        from pamctl.report.progress_line import ProgressLine
        from pamctl.sweep.run_sweep import OwnRunner, run_sweep

        silent = quiet or as_json
        own_runner = OwnRunner(points, names, logs, lambda: ProgressLine(quiet=silent))
        plan = own_runner.plan_sweep(base, request, repeats, title, said)
        end = run_sweep(plan, own_runner, tell)
    _conclude(plan, end, as_json=as_json)


def _tell(line: str, *, quiet: bool) -> None:
    if not quiet:
        print(line, file=sys.stderr, flush=True)


def _conclude(plan: SweepPlan, end: SweepEnd, *, as_json: bool) -> None:
    from pamctl.sweep.sweep_result import (
        format_points,
        format_points_csv,
        list_point_documents,
        summarise_points,
    )

    points = summarise_points(end.rows)
    saved: dict[str, str | None] = {"page": None, "csv": None}
    if points:
        from pamctl.report.html_page import write_html
        from pamctl.runs.run_row import find_varying_keys
        from pamctl.sweep.sweep_result import write_sweep_page

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
    if as_json:
        print_json(document)
    elif points:
        typer.echo(format_points(points))
        typer.echo(f"page: {saved['page']}\ntable: {saved['csv']}")
    if not end.ending.code:
        return
    print_error(end.ending.reason)
    if end.left:
        _tell(f"{end.left} runs are left: the same command with --name {plan.name}", quiet=as_json)
    raise typer.Exit(end.ending.code)
