"""The verbs that hold the rig: run, daemon, safe, doctor and calibrate. Each needs Linux."""

from __future__ import annotations

import sys
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from hal.problem import Problem, worst_level
from pamctl.base.errors import ConfigError, ExitCode
from pamctl.base.texts import count_of
from pamctl.cli.failure import Failed, print_error
from pamctl.cli.options import (
    MAY_MOVE,
    SOCKET,
    AnnotationOptions,
    flag,
    option,
    require_linux,
    verb,
)
from pamctl.cli.output import print_report, print_result, print_run_settings
from pamctl.cli.settings_from_options import (
    LoopOptions,
    RigOptions,
    SettingsOptions,
    read_file_gains,
    resolve_options,
)

if TYPE_CHECKING:  # no other verb waits for these
    from collections.abc import Callable, Sequence

    from pamctl.commissioning.bench import Bench
    from pamctl.commissioning.guided import CalibrationOutcome, Operator
    from pamctl.processes.interrupts import SignalInterrupt
    from pamctl.settings.resolve import RunSettings


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
    from pamctl.processes.interrupts import restore_signals
    from pamctl.processes.run_once import run_once
    from pamctl.recording.recorder import ignore_signals

    quiet, follows = asked.quiet, not (asked.quiet or asked.as_json)
    with restore_signals():
        done = run_once(settings, names, asked.log, quiet=quiet, shows_progress=follows, said=said)
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
        if done.code == ExitCode.SAFETY_TRIP and settings.rig.record.is_simulated:
            from pamctl.commissioning.suited_rig import advise_after_trip

            if advice := advise_after_trip(settings.plant, settings.rig.limits):
                print(f"hint: {advice}", file=sys.stderr)
    raise typer.Exit(done.code)


# --- daemon -----------------------------------------------------------------------------------


class DaemonOptions(LoopOptions):
    """`pamctl daemon`."""

    socket: Path | None = SOCKET
    group: str | None = option(
        "--group GROUP",
        "Group that may steer the rig, besides this user",
        shown="this user's group",
    )
    logs: Path = option("--logs DIRECTORY", "Directory for the log of each run", Path("logs"))
    keep: int | None = option(
        "--keep N", "Number of the daemon's logs to keep; older ones are removed",
        shown="all", low=1,
    )  # fmt: skip
    idle_after_s: float = option(
        "--idle-after SECONDS", "Idle time before the session ends", 600.0, low=1.0
    )
    monitor: bool = flag("--monitor", "Compare every run with the plant file, and say if it fits")
    monitor_plant: str | None = option(
        "--monitor-plant NAME|FILE", "Plant that --monitor compares with", shown="that of --plant"
    )
    monitor_trips: bool = flag("--monitor-trips", "Stop at the safe voltage at the monitor's alarm")
    as_json: bool = flag("--json", "Print each event as one line of JSON")


@verb
def daemon(asked: DaemonOptions) -> None:
    """Stay up: home, run experiments and hold positions as clients such as `pamctl start` ask."""
    settings, names = asked.resolve()
    if (asked.monitor_plant is not None or asked.monitor_trips) and not asked.monitor:
        raise typer.BadParameter("--monitor-plant and --monitor-trips go with --monitor")
    del names["experiment"]  # each start names its own
    watched = settings.plant if asked.monitor else None
    if asked.monitor_plant is not None:
        watched = resolve_options(None, None, None, plant=asked.monitor_plant).settings.plant
    require_linux()
    from pamctl.daemon.client import own_socket
    from pamctl.daemon.serving import serve_daemon  # no other verb waits for it

    code = serve_daemon(
        settings,
        names,
        socket=asked.socket or own_socket(),
        group=asked.group,
        logs=asked.logs,
        keep=asked.keep,
        idle_after_s=asked.idle_after_s,
        announce=asked.as_json,
        watched=watched,
        monitor_trips=asked.monitor_trips,
        file_gains=read_file_gains(settings, names["controller"]),
    )
    raise typer.Exit(int(code))


# --- safe -------------------------------------------------------------------------------------

_PATIENCE_S = 0.5
"""Time for a process that holds the device and is dying; a living one must be stopped first."""


@verb
def safe(asked: RigOptions) -> None:
    """Drive the rig to its safe voltage, in any situation."""
    settings, _ = asked.resolve()
    require_linux()
    from pamctl.processes.backends import device_of

    device, volts = device_of(settings.rig), settings.rig.safe_volts
    failure = _make_safe(settings)
    if failure is not None:
        reason = f"NOT SAFE, {device}: {volts:g} V could not be driven: {failure}"
        raise Failed(ExitCode.UNAVAILABLE, reason, device=device, safe_volts=volts)
    cal = settings.rig.calibration
    u_v = (volts - cal.driver_offset_v) / cal.driver_gain
    document = {"exit_code": 0, "device": device, "safe_volts": volts, "reason": ""}
    text = f"{device}: {volts:g} V on the output (u = {u_v:g} V): safe"
    print_result(document, text, as_json=asked.as_json)


def _make_safe(settings: RunSettings) -> Exception | None:
    from pamctl.processes.backends import build_safe_rig, require_backend
    from pamctl.processes.guardian import drive_safe

    try:
        require_backend(settings.rig)
        return drive_safe(build_safe_rig(settings.rig), _PATIENCE_S)
    # Whatever it is, the valve may be open: the line must say so.
    except Exception as error:
        return error


# --- doctor -----------------------------------------------------------------------------------

SCHEMA = 1
"""Version of the document that `--json` prints."""


class DoctorOptions(RigOptions):
    """`pamctl doctor`."""

    actuate: bool = flag("--actuate", "Fill and exhaust for a moment; the muscle moves")
    rt_seconds: float = option(
        "--rt-seconds SECONDS", "Duration of the measurement of wake-ups", 2.0, low=0.1, high=600.0
    )


@verb
def doctor(asked: DoctorOptions) -> None:
    """Check whether this PC and this rig are fit for a run, with a fix for each fault."""
    settings, _ = asked.resolve()
    require_linux()
    from pamctl.commissioning.rig_checks import examine_all
    from pamctl.processes.backends import device_of
    from pamctl.processes.interrupts import SignalInterrupt
    from pamctl.report.report import Problems, format_part

    findings: list[Problem] = []
    interrupt: SignalInterrupt | None = None
    # A simulated carriage cannot be moved by hand.
    may_ask = not asked.as_json and sys.stdin.isatty() and not settings.rig.record.is_simulated
    work = examine_all(settings, asked.rt_seconds, actuate=asked.actuate, may_ask=may_ask)
    try:
        # Closed on every path: it holds the rig.
        with closing(work):
            for finding in work:
                findings.append(finding)
                if not asked.as_json:
                    typer.echo(format_part(Problems([finding])))
    except (SignalInterrupt, KeyboardInterrupt) as error:
        interrupt = error if isinstance(error, SignalInterrupt) else SignalInterrupt(2)
    is_fit = worst_level(findings) != "fault"
    code = int(ExitCode.OK if is_fit else ExitCode.CHECK_FAILED)
    if interrupt is not None:
        code = interrupt.code
    document = {
        "schema": SCHEMA,
        "exit_code": code,
        "worst": worst_level(findings),
        "backend": settings.rig.backend,
        "device": device_of(settings.rig),
        "actuated": asked.actuate,
        "findings": [
            {
                "name": finding.key,
                "level": finding.level,
                "found": finding.message,
                "wanted": finding.wanted,
                "fix": finding.fix,
                "data": finding.data,
            }
            for finding in findings
        ],
    }
    levels = [finding.level for finding in findings]
    verdict = "{}, {}".format(*(count_of(levels.count(one), one) for one in ("fault", "warning")))
    print_result(document, str(interrupt or verdict), as_json=asked.as_json)
    raise typer.Exit(code)


# --- calibrate --------------------------------------------------------------------------------

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

    points = () if asked.zero_only else tuple(asked.points_kpa or PRESSURE_POINTS_KPA)
    work = partial(calibrate_pressure, points_kpa=points)
    _calibrate(asked, "pressure", work, points, ("--reading", asked.readings_kpa))


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

    known_mm = asked.displacements_mm
    if asked.by == "muscle":
        points = tuple(asked.points_kpa or ENCODER_POINTS_KPA)
        work = partial(calibrate_encoder_by_muscle, points_kpa=points)
        _calibrate(asked, "encoder", work, points, ("--displacement-mm", known_mm))
    elif asked.by == "hand":
        _calibrate(asked, "encoder", partial(calibrate_encoder_by_hand, displacements_mm=known_mm))
    else:
        raise ConfigError([Problem(f"--by {asked.by}", "", "must be 'hand' or 'muscle'")])


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

    _calibrate(asked, "valve", lambda bench, operator: calibrate_valve(bench, asked.span_v))


def _calibrate(
    asked: CalibrateOptions,
    what: str,
    work: Callable[[Bench, Operator], CalibrationOutcome],
    points_kpa: Sequence[float] = (),
    answers: tuple[str, Sequence[float]] = ("", ()),
) -> None:
    from pamctl.commissioning.guided import calibrate_rig
    from pamctl.processes.interrupts import SignalInterrupt

    settings, names = asked.resolve()
    files = names["rig"], asked.out
    try:
        report, failure = calibrate_rig(
            what, work, settings, *files, points_kpa=points_kpa, answers=answers, may_move=asked.yes
        )
    except SignalInterrupt as error:
        raise Failed(error.code, str(error)) from error
    print_report(report, as_json=asked.as_json, failure=failure)
