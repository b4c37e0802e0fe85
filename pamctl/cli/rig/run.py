"""`pamctl run`: one run from configuration to figures."""

from __future__ import annotations

import sys
from pathlib import Path

import typer

from pamctl.cli.failure import print_error
from pamctl.cli.options import AnnotationOptions, flag, option, require_linux, verb
from pamctl.cli.output import print_result, print_run_settings
from pamctl.cli.settings_from_options import SettingsOptions
from pamctl.exit_codes import ExitCode


class RunOptions(SettingsOptions, AnnotationOptions):
    """`pamctl run`."""

    log: Path | None = option(
        "--log FILE", "New log of the run", shown="logs/DATE-CONTROLLER-EXPERIMENT.mcap"
    )
    readonly: bool = flag("--readonly", "Read, compute and log; the output stays safe")
    dry_run: bool = flag("--dry-run", "Print the resolved configuration and stop")
    quiet: bool = flag("--quiet", "Print no progress line")


@verb
def run(asked: RunOptions) -> None:
    """Move the muscle, log every tick, and show how well it tracked."""
    said = asked.make_annotation()
    settings, names = asked.resolve()
    if asked.dry_run:
        print_run_settings(settings, as_json=asked.as_json)
        return
    if not settings.fast:
        require_linux()
    from pamctl.control.experiment import plan_experiment
    from pamctl.processes.interrupts import ignore_signals, restore_signals
    from pamctl.processes.run_once import run_once
    from pamctl.report.progress_line import ProgressLine

    length_s = plan_experiment(settings.experiment).duration_s
    length_s = min(length_s, settings.duration_s or length_s)
    progress = ProgressLine(quiet=asked.quiet or asked.as_json, length_s=length_s)
    with restore_signals():
        done = run_once(settings, names, asked.log, progress, quiet=asked.quiet, said=said)
        if done.note:
            print(f"warning: {done.note}", file=sys.stderr)
        if asked.as_json or done.text:
            print_result(done.document, done.text, as_json=asked.as_json)
        if done.code in (ExitCode.SIGINT, ExitCode.SIGTERM, ExitCode.SIGHUP):
            print(done.reason, file=sys.stderr)
            ignore_signals()
            raise typer.Exit(done.code)
        if done.reason:
            print_error(done.reason)
    raise typer.Exit(done.code)
