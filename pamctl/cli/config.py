"""`pamctl config`: check the files, show what a run would use, print the schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from pamctl.cli.backend_option import BackendOption
from pamctl.cli.options import (
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
)
from pamctl.cli.output import print_json
from pamctl.cli.settings_from_options import resolve_options
from pamctl.exit_codes import ExitCode
from pamctl.settings.config_files import config_dir
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import (
    SECTIONS,
    build_config_schema,
    check_config_file,
    settings_to_json,
    settings_to_yaml,
    shorten_path,
)
from pamctl.settings.table_file import read_tables

config_app = typer.Typer(
    no_args_is_help=True, help="Check, show and describe the configuration files."
)


@config_app.command("check")
def check_files(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[FILE]...", help="Files to check", show_default="the shipped files"
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Validate files, each by itself: one line per file, or one per problem."""
    verdicts = [_check_file(path) for path in files or _list_shipped()]
    if as_json:
        print_json([verdict.as_dict() for verdict in verdicts])
    else:
        for line in (line for verdict in verdicts for line in verdict.lines()):
            typer.echo(line)
    if any(verdict.problems for verdict in verdicts):
        raise typer.Exit(ExitCode.BAD_CONFIG)


@config_app.command("show")
def show(
    backend: BackendOption = None,
    controller: ControllerOption = None,
    controller_from: ControllerFromOption = None,
    experiment: ExperimentOption = None,
    rig: RigOption = None,
    plant: PlantOption = None,
    overrides: SetOption = None,
    seed: SeedOption = None,
    duration_s: DurationOption = None,
    fast: FastOption = False,
    rt: RtOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the configuration a run with the same options would use, defaults included."""
    settings, _ = resolve_options(
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
        rt=rt,
    )
    typer.echo(settings_to_json(settings) if as_json else settings_to_yaml(settings).rstrip())


@config_app.command("schema")
def print_schema() -> None:
    """Print the JSON schema that editors complete and check the files with."""
    typer.echo(json.dumps(build_config_schema(), indent=2))


class _FileCheck(NamedTuple):
    """What `check_config_file` found in one file; `kind` is empty where the file is not valid."""

    path: Path
    kind: str
    problems: tuple[Problem, ...]

    def lines(self) -> list[str]:
        return [str(p) for p in self.problems] or [f"{shorten_path(self.path)}: ok ({self.kind})"]

    def as_dict(self) -> dict[str, object]:
        return {
            "file": shorten_path(self.path),
            "kind": self.kind or None,
            "ok": not self.problems,
            "problems": [problem._asdict() for problem in self.problems],
        }


def _check_file(path: Path) -> _FileCheck:
    try:
        return _FileCheck(path, check_config_file(path, read_tables), ())
    except ConfigError as error:
        return _FileCheck(path, "", error.problems)


def _list_shipped() -> list[Path]:
    return [path for kind in SECTIONS for path in sorted((config_dir() / kind).glob("*.yaml"))]
