"""A calibration from the command line to the new rig file."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import typer

from hal.rig import RigError
from pamctl.cli.config import exit_on_config_errors, resolve_options
from pamctl.commissioning.calibrate.outcome import (
    CalibrationError,
    CalibrationOutcome,
    Operator,
    PreparedAnswers,
)
from pamctl.commissioning.calibrate.rig_file_text import insert_values
from pamctl.commissioning.hands_on import Bench, LimitError
from pamctl.commissioning.open_bench import open_workplace
from pamctl.commissioning.terminal_operator import NoAnswer, Terminal
from pamctl.exit_codes import ExitCode
from pamctl.processes.backends import require_backend
from pamctl.processes.interrupts import SignalInterrupt
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    find_config_file,
    settings_to_data,
    shorten_path,
    validate_settings,
)


def check_answers(
    option: str, values: Sequence[float] | None, points: Sequence[float]
) -> Sequence[float] | None:
    """Return the answers given by options, if any; leave where they do not fit the questions.

    Before anything moves: a rig is not pressurised for a number that no instrument shows.
    """
    if values is None:
        return None
    if len(values) != len(points):
        message = f"{len(values)} values for {len(points)} points; give --point as often"
        raise typer.BadParameter(message, param_hint=option)
    for value in values:
        if not (math.isfinite(value) and value > 0.0):
            raise typer.BadParameter(f"must be above 0 (got {value:g})", param_hint=option)
    return values


class CalibrationOptions(NamedTuple):
    """What every calibration is told on the command line."""

    backend: str | None
    rig: str | None
    overrides: Sequence[str]
    out: Path
    yes: bool
    as_json: bool
    points_kpa: Sequence[float] = ()
    """Pressures to hold."""


def calibrate_rig(
    what: str,
    work: Callable[[Bench, Operator], CalibrationOutcome],
    order: CalibrationOptions,
    answers: Sequence[float] | None = None,
) -> None:
    """Do the work over the rig and write what was found; nothing is written on any other path."""
    backend, rig, overrides, out, yes, as_json, points_kpa = order
    settings, names = resolve_options(backend, rig, overrides, as_json=as_json, fast=False)
    with exit_on_config_errors(as_json=as_json):
        source = find_config_file("rig", names["rig"])
        _require_new(out)
    _require_within_limit(points_kpa, settings)
    terminal = Terminal()
    try:
        if not yes:
            terminal.require_yes(
                "the rig will be pressurised and may move; is everything clear of it?"
            )
        require_backend(settings)
        with open_workplace(settings) as bench:
            outcome = work(bench, terminal if answers is None else PreparedAnswers(answers))
        with exit_on_config_errors(as_json=as_json):
            text = _make_rig_file(out, source, outcome, what)
    except (NoAnswer, CalibrationError, LimitError, RigError, SignalInterrupt) as error:
        code = _code_of(error)
        if as_json:
            typer.echo(json.dumps({"exit_code": code, "reason": str(error)}, indent=2))
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(code) from None
    failure = _write_file(out, text)
    _print_outcome(settings, outcome, out, failure, as_json=as_json)
    if failure:
        typer.echo(f"error: {failure}", err=True)
        raise typer.Exit(ExitCode.UNEXPECTED)


def _code_of(error: Exception) -> int:
    match error:
        case SignalInterrupt():
            return error.code
        case RigError():
            return int(ExitCode.UNAVAILABLE)
        case LimitError():
            return int(ExitCode.SAFETY_TRIP)
        case NoAnswer():
            return int(ExitCode.USAGE)
    return int(ExitCode.CHECK_FAILED)


def _require_new(out: Path) -> None:
    message = ""
    if out.exists():
        message = "exists, and a calibration never overwrites a file"
    elif not out.parent.is_dir():
        message = f"there is no directory {out.parent}"
    elif out.suffix not in {".yaml", ".yml"}:
        message = "must end in .yaml, for --rig to take it as a file"
    if message:
        raise ConfigError([Problem(f"--out {out}", "", message)])


def _require_within_limit(points_kpa: Sequence[float], settings: RunSettings) -> None:
    rig = settings.rig
    most_kpa = (rig.limits.pressure_pa - rig.calibration.atmospheric_pressure_pa) * 1e-3
    for point_kpa in points_kpa:
        if not point_kpa < most_kpa:
            message = f"must be below {most_kpa:g}, limits.pressure_pa as gauge (got {point_kpa:g})"
            raise typer.BadParameter(message, param_hint="--point")


def _make_rig_file(out: Path, source: Path, outcome: CalibrationOutcome, what: str) -> str:
    """Return the source's text with the values; raise `ConfigError` where that is no rig file."""
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    heading = f"{now}: pamctl calibrate {what}, from {source.name}"
    text = insert_values(source.read_text(encoding="utf-8"), outcome, heading)
    validate_settings(SECTIONS["rig"], RawSettings.parse(text, out), title="rig")
    return text


def _write_file(out: Path, text: str) -> str:
    """Write the new file; return why that failed, for the values must not be lost with it."""
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        return f"--out {out}: cannot be written: {error.strerror}"
    return ""


def _print_outcome(
    settings: RunSettings, outcome: CalibrationOutcome, out: Path, failure: str, *, as_json: bool
) -> None:
    before = settings_to_data(settings.rig)
    if as_json:
        values = [{**v._asdict(), "keys": ".".join(v.keys)} for v in outcome.values]
        code = int(ExitCode.UNEXPECTED if failure else ExitCode.OK)
        told: dict[str, Any] = {"exit_code": code, "reason": failure, "values": values}
        told["rig_file"] = None if failure else str(out)
        told |= {"notes": list(outcome.notes), "figures": dict(outcome.figures)}
        typer.echo(json.dumps(told, indent=2))
        return
    for value in outcome.values:
        section, key = value.keys
        within = f" +- {value.uncertainty:.2g}" if value.uncertainty else ""
        was = before.get(section, {}).get(key)
        typer.echo(f"{section}.{key}: {value.value:.7g}{within} {value.unit} (was {was:.7g})")
        typer.echo(f"    {value.how}")
    for note in outcome.notes:
        typer.echo(note)
    if not failure:
        typer.echo(f"rig file: {shorten_path(out)}")
