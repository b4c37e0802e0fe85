"""`pamctl sweep`: every combination of some settings, repeated."""

from __future__ import annotations

from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pamctl.cli.failure import print_error
from pamctl.cli.options import (
    LOGS,
    SOCKET,
    AnnotationOptions,
    flag,
    option,
    require_linux,
    verb,
)
from pamctl.cli.output import PAGE_BEGIN, print_report, tell
from pamctl.cli.settings_from_options import SettingsOptions, resolve_options
from pamctl.log.run_meta import file_safe_name
from pamctl.new_file import require_folder, write_files
from pamctl.settings.config_files import DEFAULT_NAMES
from pamctl.sweep.sweep_plan import parse_sweep, require_end

if TYPE_CHECKING:
    from pamctl.sweep.run_sweep import SweepEnd, SweepPlan


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
    by_daemon: bool = flag("--daemon", "Run on the daemon; only its gains can be swept")
    socket: Path | None = SOCKET
    quiet: bool = flag("--quiet", "Print no progress")


@verb
def sweep(asked: SweepOptions) -> None:
    """Run every combination of some settings, repeated; write a table and a page beside the logs.

    An interrupted sweep keeps its logs and goes on with the same command and --name.
    """
    said = asked.make_annotation()
    title = asked.name or datetime.now().strftime("sweep-%Y%m%d-%H%M%S")
    if file_safe_name(title) != title:
        allowed = "letters, digits and . _ - only, 60 at most"
        raise typer.BadParameter(f"{title!r}: {allowed}", param_hint="--name")
    request = parse_sweep(asked.overrides, asked.repeats)
    silent = asked.quiet or asked.as_json
    tell = partial(_tell, quiet=silent)
    if asked.by_daemon:
        own = ["backend", "controller", "controller_from", "rig", "plant", "seed", "rt", "fast"]
        if any(map(asked.is_typed, own)):
            raise typer.BadParameter(
                "the daemon has its own rig, plant and gains; give only --experiment, --duration "
                "and --set controller.KEY=...",
                param_hint="--daemon",
            )
        named = asked.experiment or DEFAULT_NAMES["experiment"]
        settings, _ = resolve_options(
            None, None, None, experiment=named, duration_s=asked.duration_s
        )
        require_end(settings)
        require_linux()
        from pamctl.daemon.client import Client, default_socket
        from pamctl.sweep.run_sweep import DaemonRunner, run_sweep

        with (
            Client(asked.socket or default_socket()) as client,
            DaemonRunner(client, settings, file_safe_name(named)) as runner,
        ):
            plan = runner.plan_sweep(request, asked.repeats, title, said)
            end = run_sweep(plan, runner, tell)
    else:
        base, names = asked.resolve_with(request.fixed)
        # Every point is checked before the first run.
        points = [asked.resolve_with(whole).settings for whole in request.list_overrides()]
        for settings in points:
            require_end(settings)
        require_linux()
        require_folder(asked.logs)
        asked.logs.mkdir(parents=True, exist_ok=True)
        from pamctl.report.progress_line import ProgressLine
        from pamctl.sweep.run_sweep import OwnRunner, run_sweep

        own_runner = OwnRunner(points, names, asked.logs, lambda: ProgressLine(quiet=silent))
        plan = own_runner.plan_sweep(base, request, asked.repeats, title, said)
        end = run_sweep(plan, own_runner, tell)
    _conclude(plan, end, as_json=asked.as_json)


def _tell(line: str, *, quiet: bool) -> None:
    if not quiet:
        tell(line)


def _conclude(plan: SweepPlan, end: SweepEnd, *, as_json: bool) -> None:
    from pamctl.report.report import Report
    from pamctl.sweep.sweep_result import (
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
    if points or as_json:
        said = f"{len(end.rows)} runs, mean ± standard deviation of those that ended well"
        report = Report(f"Sweep {plan.name}", said, document=document)
        report.add(*[tabulate_points(points)] * bool(points))
        files = f"\n\npage: {saved['page']}\ntable: {saved['csv']}"
        print_report(report, as_json=as_json, end=files)
    if not end.ending.code:
        return
    print_error(end.ending.reason)
    if end.left:
        _tell(f"{end.left} runs are left: the same command with --name {plan.name}", quiet=as_json)
    raise typer.Exit(end.ending.code)
