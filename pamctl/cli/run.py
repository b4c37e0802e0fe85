"""`pamctl run`: one run from configuration to figures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.backend import BackendOption
from pamctl.cli.config import (
    ControllerFromOption,
    ControllerOption,
    DurationOption,
    ExperimentOption,
    FastOption,
    JsonOption,
    PlantOption,
    RigOption,
    RtOption,
    SeedOption,
    SetOption,
    resolve_options,
)
from pamctl.cli.linux import require_linux
from pamctl.cli.live import (
    DEFAULT_LIVE_PORT,
    LiveOption,
    LiveOriginOption,
    LivePortOption,
    check_live_port,
)
from pamctl.settings.resolve import settings_to_json, settings_to_yaml


def run(
    backend: BackendOption = None,
    controller: ControllerOption = None,
    controller_from: ControllerFromOption = None,
    experiment: ExperimentOption = None,
    rig: RigOption = None,
    plant: PlantOption = None,
    log: Annotated[
        Path | None, typer.Option("--log", metavar="FILE", help="Where the log goes; logs/...")
    ] = None,
    duration_s: DurationOption = None,
    fast: FastOption = False,
    readonly: Annotated[
        bool,
        typer.Option("--readonly", help="Read, compute and log; the output stays safe."),
    ] = False,
    seed: SeedOption = None,
    overrides: SetOption = None,
    rt: RtOption = None,
    as_json: JsonOption = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the resolved configuration and stop.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress line.")] = False,
    live: LiveOption = False,
    live_port: LivePortOption = DEFAULT_LIVE_PORT,
    live_origins: LiveOriginOption = None,
) -> None:
    """Move the muscle, log every tick, and say how well it tracked."""
    settings, names = resolve_options(
        backend,
        rig,
        overrides,
        as_json=as_json,
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
    if live and settings.fast:
        raise typer.BadParameter("without a clock there is nothing live", param_hint="--live")
    origins = live_origins or ()
    port = check_live_port(live, live_port, origins)
    require_linux()
    from pamctl.processes.run_once import run_and_report

    sys.exit(run_and_report(settings, names, log, port, origins, as_json=as_json, quiet=quiet))
