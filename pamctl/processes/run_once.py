"""A run from its settings to its figures: the front's work, which needs Linux."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from hal.backend import find_backends
from hal.calibration import Zero, calibration
from hal.rig import Rig, RigError
from pamctl.cli.live import serve_live_view
from pamctl.cli.progress import ProgressLine
from pamctl.control.filters import warp_cutoff
from pamctl.exit_codes import Ending, ExitCode
from pamctl.log.naming import bare_name
from pamctl.log.run_meta import RunMeta
from pamctl.processes.backends import (
    SHARED_MEMORY,
    build_clock,
    build_rig,
    hold_device,
    require_backend,
)
from pamctl.processes.front import FrontReport, ProcessCommands, conduct_run
from pamctl.processes.loop_supervisor import STOP_SIGNALS
from pamctl.realtime.keyframe import keyframe_fields
from pamctl.realtime.tick import first_state
from pamctl.recording.log_path import LogPathError, choose_log_path
from pamctl.recording.orphans import finish_orphans
from pamctl.recording.ring import Ring, RingError
from pamctl.settings.resolve import RunSettings, resolve, settings_to_json, settings_to_yaml
from pamctl.settings.resolve import list_shipped as experiment_names


def run_and_report(
    settings: RunSettings,
    names: dict[str, str],
    log: Path | None,
    live_port: int | None,
    live_origins: Sequence[str],
    *,
    as_json: bool,
    quiet: bool,
) -> int:
    """Run, print the figures, return the exit code; `list_shipped` are those of the files."""
    try:
        # What the user got wrong is no reason to touch the valve.
        require_backend(settings)
        path = choose_log_path(log, names["controller"], names["experiment"])
        with secure_device(settings) as rig:
            finish_orphans(SHARED_MEMORY, quiet=quiet)
            meta = make_run_meta(settings, names, path)
            with Ring.create(new_ring_path(), meta, settings.rig.loop.ring_rows) as ring:
                progress = ProgressLine(quiet=quiet or as_json)
                with serve_live_view(live_port, live_origins, "--ring", str(ring.path)):
                    report = _conduct_run(ring, rig, progress, settings)
    except LogPathError as error:
        return _fail(ExitCode.USAGE, str(error), as_json=as_json)
    except (RigError, RingError) as error:
        return _fail(ExitCode.UNAVAILABLE, str(error), as_json=as_json)
    progress.done()
    return _conclude(settings, names, path, report, as_json=as_json)


@contextmanager
def secure_device(settings: RunSettings) -> Iterator[Rig]:
    """Hold the device for this run alone, and make it safe before anything else is done.

    Whatever ran before may have died with the valve open. Raises `RigError` where the device
    cannot be had.
    """
    rig = build_rig(settings, build_clock(settings, may_spin=False)).rig
    if settings.fast:  # simulated within the loop's process, and nobody's business
        yield rig
        return
    with hold_device(settings):
        rig.make_safe()
        if rig.safe_failure is not None:
            raise rig.safe_failure
        yield rig


def _conduct_run(
    ring: Ring, rig: Rig, progress: ProgressLine, settings: RunSettings
) -> FrontReport:
    start = [sys.executable, "-m"]
    guardian = None if settings.fast else [*start, "pamctl.processes.guardian_main"]
    commands = ProcessCommands([*start, "pamctl.processes.loop_main"], guardian)
    try:
        # Without a clock nothing is at stake in the front's death.
        return conduct_run(ring, commands, rig, progress, "off" if settings.fast else settings.rt)
    except BaseException:
        if not ring.head:
            ring.unlink()
        raise


def new_ring_path() -> Path:
    """Return a new name in shared memory, where the next start looks for what died."""
    return SHARED_MEMORY / f"pamctl-{os.getpid()}-{time.time_ns()}.ring"


def make_run_meta(settings: RunSettings, names: Mapping[str, str], path: Path) -> RunMeta:
    """Return what the log of a run that begins now opens with."""
    clock = build_clock(settings, may_spin=False)
    mono_ns = 0 if settings.fast else time.monotonic_ns()
    cal = calibration(settings.rig.calibration)
    controller, nominal_dt_s = settings.controller, 1.0 / settings.rig.loop.rate_hz
    backend = settings.rig.backend
    run = {**names, "law": controller.law, "backend": backend}
    package = find_backends().packages.get(backend)
    if package is not None:  # whoever reads the log without it must know what is missing
        run["backend_package"] = package
    return RunMeta(
        log_path=str(path),
        start_wall_ns=mono_ns + clock.wall_offset_ns(),
        start_mono_ns=mono_ns,
        config=json.loads(settings_to_json(settings)),
        attachments={
            "config.yaml": settings_to_yaml(settings),
            "calibration.json": json.dumps(cal._asdict()),
            "filters.json": json.dumps(
                {
                    "kind": "Butterworth, third order, trapezoidal, on the measured dt",
                    "lpf1_hz": controller.lpf1_hz,
                    "lpf2_hz": controller.lpf2_hz,
                    "lpf1_tan_at_nominal_dt": warp_cutoff(controller.lpf1_hz, nominal_dt_s),
                    "lpf2_tan_at_nominal_dt": warp_cutoff(controller.lpf2_hz, nominal_dt_s),
                }
            ),
        },
        metadata={"run": run},
        keyframe_fields=keyframe_fields(first_state(Zero(0.0, 0.0), 0.0)),
    )


def _conclude(
    settings: RunSettings,
    names: dict[str, str],
    path: Path,
    report: FrontReport,
    *,
    as_json: bool,
) -> int:
    """Print the figures; return the exit code."""
    ending = report.ending
    if report.note:
        print(f"warning: {report.note}", file=sys.stderr)
    document: dict[str, Any] = {
        "exit_code": int(ending.code),
        "reason": ending.reason,
        "log": str(path),
        "log_is_whole": report.log_is_whole,
        **names,
        "law": settings.controller.law,
        "backend": settings.rig.backend,
    }
    text = ""
    if path.exists():
        figures, text = _compute_figures(settings, names, path, ending)
        document |= figures
        if ending.code and figures.get("ticks") == 0:
            path.unlink()  # nothing happened: leave nothing behind
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        if text:
            typer.echo(text)
        if path.exists():
            typer.echo(f"log: {path}")
    if ending.code in STOP_SIGNALS.values():
        print(ending.reason, file=sys.stderr)
    elif ending.code:
        print(f"error: {ending.reason}", file=sys.stderr)
    if ending.code:
        return int(ending.code)
    return int(ExitCode.OK if report.log_is_whole else ExitCode.CHECK_FAILED)


def _compute_figures(
    settings: RunSettings, names: dict[str, str], path: Path, ending: Ending
) -> tuple[dict[str, Any], str]:
    # Slow imports, that a run must not wait for before its first tick.
    from pamctl.log.reader import LogError, read
    from pamctl.report.run_figures import format_run_summary, summarise_run

    try:
        log = read(path)
    except LogError as error:
        return {"log_error": str(error)}, f"error: {error}"
    if not len(log):
        return {"ticks": 0}, ""
    figures = summarise_run(log, _find_shipped_experiment(settings, names["experiment"]))
    text = format_run_summary(figures, settings.controller.law)
    if ending.code in (ExitCode.SAFETY_TRIP, ExitCode.OVERRUNS):
        from pamctl.log.flight import dump_last_seconds

        figures["flight_record"] = str(dump_last_seconds(log))
        text += f"\nlast two seconds: {figures['flight_record']}"
    return figures, text


def _find_shipped_experiment(settings: RunSettings, name: str) -> str | None:
    """Return the experiment's name if it is a shipped one as it stands: Table IV is about those."""
    shipped = bare_name(name)
    if shipped not in experiment_names("experiment"):
        return None
    return shipped if resolve(experiment=shipped).experiment == settings.experiment else None


def _fail(code: ExitCode, reason: str, *, as_json: bool) -> int:
    """Say why there was no run."""
    if as_json:
        typer.echo(json.dumps({"exit_code": int(code), "reason": reason}, indent=2))
    print(f"error: {reason}", file=sys.stderr)
    return int(code)
