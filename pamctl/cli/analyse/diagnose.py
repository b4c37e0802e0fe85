"""`pamctl diagnose`: which effect does the model lack?"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import (
    InteractiveOption,
    JsonOption,
    PlantOption,
    SocketOption,
    require_linux,
)
from pamctl.cli.output import print_result
from pamctl.exit_codes import ExitCode
from pamctl.new_file import NewFileError, require_empty_folder
from pamctl.settings.config_files import DEFAULT_NAMES, find_config_file
from pamctl.settings.resolve import read_section_file


def diagnose(
    context: typer.Context,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Folder for the results, new or empty",
            show_default="required, except with --dry-run",
        ),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="LOG...",
            help="Logs that the model is fitted to; with --on-rig they take the place of the "
            "first program",
            show_default="required, except with --on-rig",
        ),
    ] = None,
    holdout: Annotated[
        list[Path] | None,
        typer.Option(
            "--holdout",
            metavar="LOG",
            help="Log that is not fitted: it judges what is said, and shows the gap; can be "
            "repeated",
            show_default="none",
        ),
    ] = None,
    plant: PlantOption = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            "--without",
            metavar="EFFECT",
            help="Effect not to ask; can be repeated",
            show_default="none",
        ),
    ] = None,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            "--accept",
            metavar="RULE=REASON",
            help="Rule about the data to overrule, such as gap='logger paused'; "
            "the document keeps the reason; can be repeated",
            show_default="none",
        ),
    ] = None,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            "--noise",
            metavar="CHANNEL=SIGMA",
            help="Noise of a sensor, as a standard deviation in SI, such as position_m=2e-6; "
            "can be repeated",
            show_default="from the records",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", metavar="N", min=1, help="Number of threads", show_default="all cores"
        ),
    ] = None,
    interactive: InteractiveOption = False,
    on_rig: Annotated[
        bool,
        typer.Option(
            "--on-rig",
            help="Let a running daemon run programs, each chosen to decide what is left",
        ),
    ] = False,
    experiment: Annotated[
        str,
        typer.Option("--experiment", metavar="NAME|FILE", help="First program on the rig"),
    ] = "diagnosis",
    runs: Annotated[
        int,
        typer.Option("--runs", metavar="N", min=1, max=20, help="Most programs on the rig"),
    ] = 4,
    minutes: Annotated[
        float,
        typer.Option("--minutes", metavar="M", min=0.3, max=120.0, help="Most time on the rig"),
    ] = 5.0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan on the rig and stop")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask whether the rig may be pressurised and move")
    ] = False,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find what the model lacks to explain the logs, say what is sure of it, and add it.

    DIR gets diagnosis.json, report.html and plant.yaml, and next-experiment.yaml where a program
    would decide between explanations. plant.yaml is for --plant of run, tune, compare and a next
    diagnose. The exit code is 0 for every verdict, and 65 if the data cannot be used.
    """
    logs = logs or []
    _require_one_kind(context, logs, on_rig=on_rig)
    if out is not None:
        require_empty_folder(out)
    elif not dry_run:
        raise typer.BadParameter("name a folder for the results", param_hint="--out")
    start = read_section_file("plant", find_config_file("plant", plant or DEFAULT_NAMES["plant"]))
    _require_known(without or [])
    if on_rig:
        require_linux()
        from pamctl.cli.analyse.on_rig import OnRigTask, diagnose_on_rig

        task = OnRigTask(
            logs,
            out,
            start,
            experiment,
            runs,
            minutes,
            socket,
            dry_run=dry_run,
            yes=yes,
        )
        diagnose_on_rig(task, as_json=as_json)
        return
    assert out is not None  # only --dry-run, which is for --on-rig, goes without
    from pamctl.diagnose import diagnose as find_missing_effects
    from pamctl.diagnose import summary
    from pamctl.diagnose.record import record_of, require_held_out
    from pamctl.diagnose.refuse import read_acceptances
    from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
    from pamctl.diagnose.report.diagnosis_page import write_diagnosis

    accepted = read_acceptances(accept or [])
    require_held_out(logs, holdout or [])
    stated = _parse_noise(noise or [])
    train = [record_of(path) for path in logs]
    held = [record_of(path) for path in holdout or []]
    for record in (*train, *held):
        for note in record.notes:
            typer.echo(f"warning: {record.name}: {note}", err=True)
    if not held:
        typer.echo("no --holdout: two stretches of each log are held out", err=True)
    diagnosis = find_missing_effects(
        train,
        held,
        start,
        without=without or (),
        accept=accepted,
        noise=stated,
        jobs=jobs,
        progress=lambda line: typer.echo(line, err=True),
    )
    names = [path.name for path in (*logs, *(holdout or []))]
    failure, end = None, ""
    try:
        written = write_diagnosis(diagnosis, out, names, [*train, *held], interactive=interactive)
        end = f"\n\n{out}: {', '.join(written)}"
    except NewFileError as error:
        failure = error
    document = build_diagnosis_document(diagnosis)
    print_result(document, lambda: summary(diagnosis) + end, failure, as_json=as_json)
    raise typer.Exit(ExitCode.BAD_DATA if diagnosis.reason else ExitCode.OK)


_FOR_RIG = ("experiment", "runs", "minutes", "dry_run", "yes", "socket")
_FOR_LOGS = ("holdout", "without", "accept", "noise", "jobs", "interactive")


def _require_one_kind(context: typer.Context, logs: Sequence[Path], *, on_rig: bool) -> None:
    """Refuse options that would have no effect, and a diagnosis of nothing."""
    wrong = _FOR_LOGS if on_rig else _FOR_RIG
    for name in wrong:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = f"--{name.replace('_', '-')}"
            why = "has no effect with --on-rig" if on_rig else "is for --on-rig; add it"
            raise typer.BadParameter(why, param_hint=option)
    if not logs and not on_rig:
        raise typer.BadParameter(
            "name at least one log, or give --on-rig and let a daemon make them",
            param_hint="LOG...",
        )


def _require_known(names: Sequence[str]) -> None:
    from pamctl.plant.catalogue import CATALOGUE

    for name in names:
        if name not in CATALOGUE:
            near = get_close_matches(name, CATALOGUE, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise typer.BadParameter(
                f"there is no effect {name} in the catalogue{hint}", param_hint="--without"
            )


def _parse_noise(texts: Sequence[str]) -> dict[str, float]:
    from pamctl.diagnose.record import parse_noise

    try:
        return parse_noise(texts)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--noise") from error
