"""`pamctl config`: check the files, show what a run would use, print the schema."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NamedTuple, TypedDict, Unpack

import typer

from pamctl.cli.backend import BackendOption, check_backend, rig_name
from pamctl.exit_codes import ExitCode
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import (
    DEFAULT_NAMES,
    SECTIONS,
    RunSettings,
    build_config_schema,
    check_config_file,
    config_dir,
    find_config_file,
    resolve,
    settings_to_json,
    settings_to_yaml,
    shorten_path,
)

config_app = typer.Typer(
    no_args_is_help=True, help="Check, show and describe the configuration files."
)

# Shared by every verb that chooses a run, so that all of them read alike.
ControllerOption = Annotated[
    str | None, typer.Option("--controller", metavar="NAME|FILE", help="Law and its gains; qsmc.")
]
ControllerFromOption = Annotated[
    str | None,
    typer.Option(
        "--controller-from",
        metavar="FILE.py[:NAME]",
        help="Use the law that this Python file defines. Its gains: --controller, or defaults.",
    ),
]
ExperimentOption = Annotated[
    str | None, typer.Option("--experiment", metavar="NAME|FILE", help="What to do; tracking-2.")
]
RigOption = Annotated[
    str | None, typer.Option("--rig", metavar="NAME|FILE", help="Calibration and limits; sim.")
]
PlantOption = Annotated[
    str | None, typer.Option("--plant", metavar="NAME|FILE", help="Model of the muscle; paper.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="As in controller.lambda_per_s=12; repeats."),
]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Of the simulated noise; 0.")]
DurationOption = Annotated[
    float | None, typer.Option("--duration", metavar="SECONDS", help="End the run early.")
]
FastOption = Annotated[bool, typer.Option("--fast", help="Simulate without a clock.")]
RtOption = Annotated[
    str | None, typer.Option("--rt", metavar="auto|require|off", help="Real-time scheduling; auto.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]


@contextmanager
def exit_on_config_errors(*, as_json: bool = False) -> Iterator[None]:
    """Print what is wrong, a line each; exit with 2 for options and 78 for configuration."""
    try:
        yield
    except ConfigError as error:
        code = _exit_code(error.problems)
        if as_json:
            problems = [problem._asdict() for problem in error.problems]
            told = {"exit_code": int(code), "reason": str(error), "problems": problems}
            typer.echo(json.dumps(told, indent=2))
        typer.echo(str(error), err=True)
        raise typer.Exit(code) from None


def _exit_code(problems: Iterable[Problem]) -> ExitCode:
    places = (problem.where for problem in problems)
    options_only = all(where.startswith("--") and not where.startswith("--set") for where in places)
    return ExitCode.USAGE if options_only else ExitCode.BAD_CONFIG


def find_argument_file(section: str, name: str) -> Path:
    """Return the file that an argument without an option means; leave with 2 where none is."""
    try:
        return find_config_file(section, name)
    except ConfigError as error:
        told = "; ".join(problem.message for problem in error.problems)
        raise typer.BadParameter(f"{name!r}: {told}") from None


class ResolvedOptions(NamedTuple):
    """What the options of a verb come to."""

    settings: RunSettings
    names: dict[str, str]
    """Of the files, by section."""


class VerbOptions(TypedDict, total=False):
    """Options of a verb beside its rig; those that it has not got are left out."""

    controller: str | None
    controller_from: str | None
    experiment: str | None
    plant: str | None
    seed: int | None
    duration_s: float | None
    fast: bool | None
    readonly: bool | None
    rt: str | None


def resolve_options(
    backend: str | None,
    rig: str | None,
    overrides: Sequence[str] | None,
    *,
    as_json: bool = False,
    **words: Unpack[VerbOptions],
) -> ResolvedOptions:
    """Settle what the options mean together; leave as `exit_on_config_errors` does."""
    with exit_on_config_errors(as_json=as_json):
        named_rig = rig_name(backend, rig)
        settings = resolve(rig=named_rig, overrides=overrides or (), **words)
        check_backend(settings, backend, rig)
    named = {"rig": named_rig, **words}
    if words.get("controller_from") and not words.get("controller"):
        named["controller"] = settings.controller.law
    names = {section: str(named.get(section) or DEFAULT_NAMES[section]) for section in SECTIONS}
    return ResolvedOptions(settings, names)


@config_app.command("check")
def check_files(
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE]...", help="The shipped files if none is given."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Validate files, each by itself: one line per file, or one per problem."""
    verdicts = [_check_file(path) for path in files or _list_shipped()]
    if as_json:
        typer.echo(json.dumps([verdict.as_dict() for verdict in verdicts], indent=2))
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
        as_json=as_json,
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
    """What `check_config_file` found of one file; `kind` is empty where the file is not valid."""

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
        return _FileCheck(path, check_config_file(path), ())
    except ConfigError as error:
        return _FileCheck(path, "", error.problems)


def _list_shipped() -> list[Path]:
    return [path for kind in SECTIONS for path in sorted((config_dir() / kind).glob("*.yaml"))]
