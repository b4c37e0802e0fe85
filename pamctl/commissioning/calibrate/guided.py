"""A calibration with a person at the rig, from the settings to the new rig file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.commissioning.calibrate.outcome import CalibrationOutcome, Operator, PreparedAnswers
from pamctl.commissioning.calibrate.rig_file_text import insert_values
from pamctl.commissioning.hands_on import Bench
from pamctl.commissioning.open_bench import open_workplace
from pamctl.commissioning.terminal_operator import Terminal
from pamctl.new_file import NewFileError, require_place, write_files
from pamctl.processes.backends import require_backend
from pamctl.settings.config_files import find_config_file
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    settings_to_data,
    shorten_path,
    validate_settings,
)


def check_answers(
    option: str, values: Sequence[float] | None, points: Sequence[float]
) -> Sequence[float] | None:
    """Return the answers given by an option, if any; raise `ConfigError` where they do not fit.

    Called before anything moves: a rig is not pressurised for a number that no instrument shows.
    """
    if values is None:
        return None
    if len(values) != len(points):
        message = f"{len(values)} values for {len(points)} points; give --point as often"
        raise ConfigError([Problem(option, "", message)])
    for value in values:
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigError([Problem(option, "", f"must be above 0 (got {value:g})")])
    return values


class CalibrationTask(NamedTuple):
    """What is calibrated, and where the result goes."""

    what: str
    """Verb: pressure, encoder, valve."""
    settings: RunSettings
    rig: str
    """Name or path of the rig file that is copied."""
    out: Path
    points_kpa: Sequence[float]
    """Pressures to hold, kPa gauge; empty where none is held."""
    work: Callable[[Bench, Operator], CalibrationOutcome]


class CalibratedRig(NamedTuple):
    """What a calibration found, and what became of it."""

    settings: RunSettings
    """Before the calibration."""
    outcome: CalibrationOutcome
    out: Path
    failure: NewFileError | None
    """Why the file could not be written; None where it was."""


def calibrate_rig(
    task: CalibrationTask, answers: Sequence[float] | None, *, may_move: bool
) -> CalibratedRig:
    """Calibrate, and write the new rig file; an error leaves no file behind.

    The person is asked where `answers` are missing, and whether the rig may move unless
    `may_move`. Raises `ConfigError`, `NewFileError`, `NoAnswer`, `CalibrationError`,
    `LimitError`, `RigError` and `SignalInterrupt`.
    """
    settings = task.settings
    source = find_config_file("rig", task.rig)
    _require_new(task.out)
    _require_within_limit(task.points_kpa, settings)
    terminal = Terminal()
    if not may_move:
        terminal.require_yes("the rig will be pressurised and may move; is everything clear of it?")
    require_backend(settings)
    with open_workplace(settings) as bench:
        outcome = task.work(bench, terminal if answers is None else PreparedAnswers(answers))
    text = _make_rig_file(task.out, source, outcome, task.what)
    failure = None
    try:
        write_files({task.out: text})
    except NewFileError as error:  # the values must not be lost with the file
        failure = error
    return CalibratedRig(settings, outcome, task.out, failure)


def _require_new(out: Path) -> None:
    if out.suffix not in {".yaml", ".yml"}:
        message = "must end in .yaml, for --rig to take it as a file"
        raise ConfigError([Problem(f"--out {out}", "", message)])
    require_place(out)


def _require_within_limit(points_kpa: Sequence[float], settings: RunSettings) -> None:
    rig = settings.rig
    most_kpa = (rig.limits.pressure_pa - rig.calibration.atmospheric_pressure_pa) * 1e-3
    for point_kpa in points_kpa:
        if not point_kpa < most_kpa:
            message = f"must be below {most_kpa:g}, limits.pressure_pa as gauge (got {point_kpa:g})"
            raise ConfigError([Problem("--point", "", message)])


def _make_rig_file(out: Path, source: Path, outcome: CalibrationOutcome, what: str) -> str:
    """Return the source's text with the values; raise `ConfigError` if that is no rig file."""
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    heading = f"{now}: pamctl calibrate {what}, from {source.name}"
    text = insert_values(source.read_text(encoding="utf-8"), outcome, heading)
    validate_settings(SECTIONS["rig"], RawSettings.parse(text, out), title="rig")
    return text


def make_calibration_document(made: CalibratedRig) -> dict[str, Any]:
    """Return what was found as one document; SI, keys as in the rig file."""
    outcome = made.outcome
    return {
        "values": [{**v._asdict(), "keys": ".".join(v.keys)} for v in outcome.values],
        "rig_file": None if made.failure else str(made.out),
        "notes": list(outcome.notes),
        "figures": dict(outcome.figures),
    }


def format_calibration(made: CalibratedRig) -> str:
    """Return what was found for people: each value beside the one before."""
    before = settings_to_data(made.settings.rig)
    lines = []
    for value in made.outcome.values:
        section, key = value.keys
        within = f" +- {value.uncertainty:.2g}" if value.uncertainty else ""
        was = before.get(section, {}).get(key)
        lines.append(f"{section}.{key}: {value.value:.7g}{within} {value.unit} (was {was:.7g})")
        lines.append(f"    {value.how}")
    lines += made.outcome.notes
    if not made.failure:
        lines.append(f"rig file: {shorten_path(made.out)}")
    return "\n".join(lines)
