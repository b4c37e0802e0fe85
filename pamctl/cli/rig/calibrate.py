"""`pamctl calibrate`: sensor, encoder and valve, into a new rig file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pamctl.cli.failure import Failed
from pamctl.cli.options import MAY_MOVE, flag, option, require_linux, verb
from pamctl.cli.output import print_report
from pamctl.cli.settings_from_options import RigOptions
from pamctl.errors import ConfigError, Problem

if TYPE_CHECKING:  # no other verb waits for these
    from collections.abc import Sequence

    from pamctl.commissioning.bench import Bench
    from pamctl.commissioning.guided import CalibrationOutcome, CalibrationTask, Operator

calibrate_app = typer.Typer(
    no_args_is_help=True,
    help="Measure sensor, encoder and valve of the rig, and write a new rig file.",
)


class CalibrateOptions(RigOptions):
    """What every calibration is asked."""

    out: Path = option("--out FILE", "New rig file; an existing file is refused", ...)
    yes: bool = MAY_MOVE


class PressureOptions(CalibrateOptions):
    """`pamctl calibrate pressure`."""

    points_kpa: list[float] = option(
        "--point KPA",
        "Pressure to hold, kPa gauge; can be repeated",
        shown="100, 200, 300",
        low=1.0,
    )
    readings_kpa: list[float] = option(
        "--reading KPA",
        "Reading of the reference gauge, one for each --point, above 0 kPa",
        shown="asked at the terminal",
    )
    zero_only: bool = flag("--zero-only", "Find the zero only; no reference gauge is needed")


@calibrate_app.command("pressure")
@verb
def pressure(asked: PressureOptions) -> None:
    """Find the pressure sensor's zero at the atmosphere, and its gain against a reference gauge."""
    require_linux()
    from pamctl.commissioning.calibrations import PRESSURE_POINTS_KPA, calibrate_pressure
    from pamctl.commissioning.guided import CalibrationTask, check_answers

    settings, names = asked.resolve()
    points = () if asked.zero_only else tuple(asked.points_kpa or PRESSURE_POINTS_KPA)
    task = CalibrationTask(
        "pressure",
        settings,
        names["rig"],
        asked.out,
        points,
        lambda bench, operator: calibrate_pressure(bench, operator, points),
    )
    answers = check_answers("--reading", asked.readings_kpa or None, points)
    _calibrate(task, answers, asked)


class EncoderOptions(CalibrateOptions):
    """`pamctl calibrate encoder`."""

    by: str = option("--by hand|muscle", "What moves the carriage", "hand")
    displacements_mm: list[float] = option(
        "--displacement-mm MM",
        "Known displacement: a gauge block, or the contraction at each --point; can be repeated",
        shown="asked at the terminal",
    )
    points_kpa: list[float] = option(
        "--point KPA", "Pressure to hold, kPa gauge; can be repeated", shown="250", low=1.0
    )


@calibrate_app.command("encoder")
@verb
def encoder(asked: EncoderOptions) -> None:
    """Find the encoder's scale and sign against known displacements, moved by hand or muscle."""
    require_linux()
    from pamctl.commissioning.calibrations import (
        ENCODER_POINTS_KPA,
        calibrate_encoder_by_hand,
        calibrate_encoder_by_muscle,
    )
    from pamctl.commissioning.guided import CalibrationTask, check_answers

    points = tuple(asked.points_kpa or ENCODER_POINTS_KPA)
    known_mm = tuple(asked.displacements_mm)

    def work(bench: Bench, operator: Operator) -> CalibrationOutcome:
        if asked.by == "muscle":
            return calibrate_encoder_by_muscle(bench, operator, points)
        return calibrate_encoder_by_hand(bench, operator, known_mm)

    if asked.by not in {"hand", "muscle"}:
        raise ConfigError([Problem(f"--by {asked.by}", "", "must be 'hand' or 'muscle'")])
    settings, names = asked.resolve()
    held = points if asked.by == "muscle" else ()
    answers = None
    if held:
        answers = check_answers("--displacement-mm", asked.displacements_mm or None, held)
    task = CalibrationTask("encoder", settings, names["rig"], asked.out, held, work)
    _calibrate(task, answers, asked)


class ValveOptions(CalibrateOptions):
    """`pamctl calibrate valve`."""

    span_v: float = option(
        "--span V", "Search range around the null, +- V", 1.0, low=0.05, high=5.0
    )


@calibrate_app.command("valve")
@verb
def valve(asked: ValveOptions) -> None:
    """Find the valve's sign, null voltage and dead band, and the supply pressure."""
    require_linux()
    from pamctl.commissioning.calibrations import calibrate_valve
    from pamctl.commissioning.guided import CalibrationTask

    settings, names = asked.resolve()
    task = CalibrationTask(
        "valve",
        settings,
        names["rig"],
        asked.out,
        (),
        lambda bench, operator: calibrate_valve(bench, asked.span_v),
    )
    _calibrate(task, None, asked)


def _calibrate(
    task: CalibrationTask, answers: Sequence[float] | None, asked: CalibrateOptions
) -> None:
    from pamctl.commissioning.guided import calibrate_rig, report_calibration
    from pamctl.processes.interrupts import SignalInterrupt

    try:
        made = calibrate_rig(task, answers, may_move=asked.yes)
    except SignalInterrupt as error:
        raise Failed(error.code, str(error)) from error
    print_report(report_calibration(made), as_json=asked.as_json, failure=made.failure)
