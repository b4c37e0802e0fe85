"""`pamctl run`: one run from configuration to figures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

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
    SetOption,
    TagOption,
    require_linux,
)
from pamctl.cli.output import print_json
from pamctl.cli.settings_from_options import resolve_options
from pamctl.exit_codes import ExitCode
from pamctl.log.annotation import make_annotation
from pamctl.settings.resolve import settings_to_json, settings_to_yaml


def run(
    backend: BackendOption = None,
    controller: ControllerOption = None,
    controller_from: ControllerFromOption = None,
    experiment: ExperimentOption = None,
    rig: RigOption = None,
    plant: PlantOption = None,
    log: Annotated[
        Path | None,
        typer.Option(
            "--log",
            metavar="FILE",
            help="New log of the run",
            show_default="logs/DATE-CONTROLLER-EXPERIMENT.mcap",
        ),
    ] = None,
    duration_s: DurationOption = None,
    fast: FastOption = False,
    readonly: Annotated[
        bool,
        typer.Option("--readonly", help="Read, compute and log; the output stays safe"),
    ] = False,
    seed: SeedOption = None,
    overrides: SetOption = None,
    rt: RtOption = None,
    note: NoteOption = None,
    operator: OperatorOption = None,
    sample: SampleOption = None,
    tags: TagOption = None,
    as_json: JsonOption = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the resolved configuration and stop")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print no progress line")] = False,
) -> None:
    """Move the muscle, log every tick, and show how well it tracked."""
    said = make_annotation(tags or (), note, operator, sample)
    settings, names = resolve_options(
        backend,
        rig,
        overrides,
        controller=controller,
        controller_from=controller_from,
        experiment=experiment,
        plant=plant,
        seed=seed,
        duration_s=duration_s,
        fast=fast or None,
        readonly=readonly or None,
        rt=rt,
    )
    if dry_run:
        typer.echo(settings_to_json(settings) if as_json else settings_to_yaml(settings).rstrip())
        return
    if not settings.fast:
        require_linux()
    from pamctl.control.experiment import plan_experiment
    from pamctl.processes.interrupts import ignore_signals, restore_signals
    from pamctl.processes.run_once import run_once
    from pamctl.report.progress_line import ProgressLine

    length_s = plan_experiment(settings.experiment).duration_s
    length_s = min(length_s, settings.duration_s or length_s)
    progress = ProgressLine(quiet=quiet or as_json, length_s=length_s)
    with restore_signals():
        done = run_once(settings, names, log, progress, quiet=quiet, said=said)
        if done.note:
            print(f"warning: {done.note}", file=sys.stderr)
        if as_json:
            print_json(done.document)
        elif done.text:
            typer.echo(done.text)
        if done.code in (ExitCode.SIGINT, ExitCode.SIGTERM, ExitCode.SIGHUP):
            print(done.reason, file=sys.stderr)
            ignore_signals()
            raise typer.Exit(done.code)
        if done.reason:
            print_error(done.reason)
    raise typer.Exit(done.code)
