"""`pamctl calibrate`: sensor, encoder and valve, into a rig file of its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.backend import BackendOption
from pamctl.cli.config import JsonOption, RigOption, SetOption, exit_on_config_errors
from pamctl.cli.linux import require_linux
from pamctl.settings.problems import ConfigError, Problem

if TYPE_CHECKING:  # no other verb has to wait for these
    from pamctl.commissioning.calibrate.outcome import CalibrationOutcome, Operator
    from pamctl.commissioning.hands_on import Bench

calibrate_app = typer.Typer(
    no_args_is_help=True,
    help="Find the rig's own numbers, and write them into a rig file of their own.",
)

OutOption = Annotated[
    Path, typer.Option("--out", metavar="FILE", help="The new rig file; never an existing one.")
]
YesOption = Annotated[bool, typer.Option("--yes", help="The rig may move: do not ask.")]
PointOption = Annotated[
    list[float] | None,
    typer.Option("--point", metavar="KPA", min=1.0, help="Pressure to hold, kPa gauge; repeats."),
]


@calibrate_app.command("pressure")
def pressure(
    out: OutOption,
    backend: BackendOption = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    points_kpa: PointOption = None,
    readings_kpa: Annotated[
        list[float] | None,
        typer.Option(
            "--reading", metavar="KPA", help="The gauge's, one for each --point; repeats."
        ),
    ] = None,
    zero_only: Annotated[bool, typer.Option("--zero-only", help="No gauge: the zero alone.")] = (
        False
    ),
    yes: YesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Sensor zero at the atmosphere; gain against a reference gauge, at one point or more."""
    require_linux()
    from pamctl.commissioning.calibrate.guided import (
        CalibrationOptions,
        calibrate_rig,
        check_answers,
    )
    from pamctl.commissioning.calibrate.pressure_sensor import (
        DEFAULT_POINTS_KPA,
        calibrate_pressure,
    )

    points = () if zero_only else tuple(points_kpa or DEFAULT_POINTS_KPA)
    calibrate_rig(
        "pressure",
        lambda bench, operator: calibrate_pressure(bench, operator, points),
        CalibrationOptions(backend, rig, overrides or [], out, yes, as_json, points),
        check_answers("--reading", readings_kpa, points),
    )


@calibrate_app.command("encoder")
def encoder(
    out: OutOption,
    backend: BackendOption = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    by: Annotated[
        str,
        typer.Option("--by", metavar="hand|muscle", help="What moves the carriage; hand."),
    ] = "hand",
    displacements_mm: Annotated[
        list[float] | None,
        typer.Option(
            "--displacement-mm", help="Gauge block; or contraction at each --point; repeats."
        ),
    ] = None,
    points_kpa: PointOption = None,
    yes: YesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Scale and sign against known displacements: by gauge blocks, or measured on the muscle."""
    require_linux()
    from pamctl.commissioning.calibrate.encoder_sign_and_scale import (
        DEFAULT_POINTS_KPA,
        calibrate_encoder_by_hand,
        calibrate_encoder_by_muscle,
    )
    from pamctl.commissioning.calibrate.guided import (
        CalibrationOptions,
        calibrate_rig,
        check_answers,
    )

    points = tuple(points_kpa or DEFAULT_POINTS_KPA)
    known = tuple(displacements_mm or ())

    def work(bench: Bench, operator: Operator) -> CalibrationOutcome:
        if by == "muscle":
            return calibrate_encoder_by_muscle(bench, operator, points)
        return calibrate_encoder_by_hand(bench, operator, known)

    with exit_on_config_errors(as_json=as_json):
        if by not in {"hand", "muscle"}:
            raise ConfigError([Problem(f"--by {by}", "", "must be 'hand' or 'muscle'")])
    calibrate_rig(
        "encoder",
        work,
        CalibrationOptions(
            backend, rig, overrides or [], out, yes, as_json, points if by == "muscle" else ()
        ),
        check_answers("--displacement-mm", displacements_mm, points) if by == "muscle" else None,
    )


@calibrate_app.command("valve")
def valve(
    out: OutOption,
    backend: BackendOption = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    span_v: Annotated[
        float, typer.Option("--span", min=0.05, max=5.0, help="Search so far around the null, V.")
    ] = 1.0,
    yes: YesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Sign, null voltage, dead band and supply pressure."""
    require_linux()
    from pamctl.commissioning.calibrate.guided import CalibrationOptions, calibrate_rig
    from pamctl.commissioning.calibrate.valve_null import calibrate_valve

    calibrate_rig(
        "valve",
        lambda bench, operator: calibrate_valve(bench, span_v),
        CalibrationOptions(backend, rig, overrides or [], out, yes, as_json),
    )
