"""`pamctl calibrate`: sensor, encoder and valve, into a new rig file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pamctl.cli.backend_option import BackendOption
from pamctl.cli.failure import Failed
from pamctl.cli.options import JsonOption, RigOption, SetOption, require_linux
from pamctl.cli.output import print_result
from pamctl.cli.settings_from_options import resolve_options
from pamctl.exit_codes import ExitCode
from pamctl.settings.problems import ConfigError, Problem

if TYPE_CHECKING:  # no other verb waits for these
    from collections.abc import Sequence

    from pamctl.commissioning.bench import Bench
    from pamctl.commissioning.guided import CalibrationOutcome, CalibrationTask, Operator

calibrate_app = typer.Typer(
    no_args_is_help=True,
    help="Measure sensor, encoder and valve of the rig, and write a new rig file.",
)

OutOption = Annotated[
    Path,
    typer.Option("--out", metavar="FILE", help="New rig file; an existing file is refused"),
]
YesOption = Annotated[
    bool, typer.Option("--yes", help="Do not ask whether the rig may be pressurised and move")
]


def _point_option(default: str) -> Any:
    """Return the option for pressures to hold; the defaults are those of the calibrations."""
    return typer.Option(
        "--point",
        metavar="KPA",
        min=1.0,
        help="Pressure to hold, kPa gauge; can be repeated",
        show_default=default,
    )


@calibrate_app.command("pressure")
def pressure(
    out: OutOption,
    backend: BackendOption = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    points_kpa: Annotated[list[float] | None, _point_option("100, 200, 300")] = None,
    readings_kpa: Annotated[
        list[float] | None,
        typer.Option(
            "--reading",
            metavar="KPA",
            help="Reading of the reference gauge, one for each --point, above 0 kPa",
            show_default="asked at the terminal",
        ),
    ] = None,
    zero_only: Annotated[
        bool, typer.Option("--zero-only", help="Find the zero only; no reference gauge is needed")
    ] = False,
    yes: YesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the pressure sensor's zero at the atmosphere, and its gain against a reference gauge."""
    require_linux()
    from pamctl.commissioning.calibrations import (
        PRESSURE_POINTS_KPA,
        calibrate_pressure,
    )
    from pamctl.commissioning.guided import CalibrationTask, check_answers

    settings, names = resolve_options(backend, rig, overrides, fast=False)
    points = () if zero_only else tuple(points_kpa or PRESSURE_POINTS_KPA)
    task = CalibrationTask(
        "pressure",
        settings,
        names["rig"],
        out,
        points,
        lambda bench, operator: calibrate_pressure(bench, operator, points),
    )
    answers = check_answers("--reading", readings_kpa, points)
    _calibrate(task, answers, yes=yes, as_json=as_json)


@calibrate_app.command("encoder")
def encoder(
    out: OutOption,
    backend: BackendOption = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    by: Annotated[
        str,
        typer.Option("--by", metavar="hand|muscle", help="What moves the carriage"),
    ] = "hand",
    displacements_mm: Annotated[
        list[float] | None,
        typer.Option(
            "--displacement-mm",
            metavar="MM",
            help="Known displacement: a gauge block, or the contraction at each --point; "
            "can be repeated",
            show_default="asked at the terminal",
        ),
    ] = None,
    points_kpa: Annotated[list[float] | None, _point_option("250")] = None,
    yes: YesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the encoder's scale and sign against known displacements, moved by hand or muscle."""
    require_linux()
    from pamctl.commissioning.calibrations import (
        ENCODER_POINTS_KPA,
        calibrate_encoder_by_hand,
        calibrate_encoder_by_muscle,
    )
    from pamctl.commissioning.guided import CalibrationTask, check_answers

    points = tuple(points_kpa or ENCODER_POINTS_KPA)
    known_mm = tuple(displacements_mm or ())

    def work(bench: Bench, operator: Operator) -> CalibrationOutcome:
        if by == "muscle":
            return calibrate_encoder_by_muscle(bench, operator, points)
        return calibrate_encoder_by_hand(bench, operator, known_mm)

    if by not in {"hand", "muscle"}:
        raise ConfigError([Problem(f"--by {by}", "", "must be 'hand' or 'muscle'")])
    settings, names = resolve_options(backend, rig, overrides, fast=False)
    held: tuple[float, ...] = ()
    answers = None
    if by == "muscle":
        held, answers = points, check_answers("--displacement-mm", displacements_mm, points)
    task = CalibrationTask("encoder", settings, names["rig"], out, held, work)
    _calibrate(task, answers, yes=yes, as_json=as_json)


@calibrate_app.command("valve")
def valve(
    out: OutOption,
    backend: BackendOption = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    span_v: Annotated[
        float,
        typer.Option(
            "--span",
            metavar="V",
            min=0.05,
            max=5.0,
            help="Search range around the null, +- V",
        ),
    ] = 1.0,
    yes: YesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the valve's sign, null voltage and dead band, and the supply pressure."""
    require_linux()
    from pamctl.commissioning.calibrations import calibrate_valve
    from pamctl.commissioning.guided import CalibrationTask

    settings, names = resolve_options(backend, rig, overrides, fast=False)
    task = CalibrationTask(
        "valve",
        settings,
        names["rig"],
        out,
        (),
        lambda bench, operator: calibrate_valve(bench, span_v),
    )
    _calibrate(task, None, yes=yes, as_json=as_json)


def _calibrate(
    task: CalibrationTask, answers: Sequence[float] | None, *, yes: bool, as_json: bool
) -> None:
    from pamctl.commissioning.guided import (
        calibrate_rig,
        format_calibration,
        make_calibration_document,
    )
    from pamctl.processes.interrupts import SignalInterrupt

    try:
        made = calibrate_rig(task, answers, may_move=yes)
    except SignalInterrupt as error:
        raise Failed(error.code, str(error)) from error
    document = {"exit_code": int(ExitCode.OK), "reason": "", **make_calibration_document(made)}
    print_result(document, lambda: format_calibration(made), made.failure, as_json=as_json)
