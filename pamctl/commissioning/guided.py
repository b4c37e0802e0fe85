"""A calibration with a person at the rig, from the settings to the new rig file.

The new file is the text of the old one with the values put in; its comments and order stay.
"""

from __future__ import annotations

import copy
import math
import re
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from hal.rig import RawSample
from pamctl.base.errors import ConfigError, ExitCode, Problem
from pamctl.base.new_file import NewFileError, require_place, write_files
from pamctl.commissioning.bench import (
    Bench,
    SensorStatistics,
    Terminal,
    open_workplace,
    summarise_samples,
)
from pamctl.processes.backends import require_backend
from pamctl.report.report import Facts, Report, Text
from pamctl.settings.config_files import find_config_file
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    settings_to_data,
    shorten_path,
    validate_settings,
)
from pamctl.settings.yaml12 import YamlError, dump_yaml, parse_yaml


def calibrate_rig(
    what: str,
    work: Callable[[Bench, Operator], CalibrationOutcome],
    settings: RunSettings,
    rig: str,
    out: Path,
    *,
    points_kpa: Sequence[float] = (),
    answers: tuple[str, Sequence[float]] = ("", ()),
    may_move: bool,
) -> tuple[Report, NewFileError | None]:
    """Calibrate `what`, and write the file of `rig` with the new values; an error leaves no file.

    `points_kpa` are pressures to hold, kPa gauge; `answers` are given in advance by an option of
    this name. Returns what was found, and why the file could not be written. The person is asked
    where answers are missing, and whether the rig may move unless `may_move`. Raises `ConfigError`,
    `NewFileError`, `NoAnswer`, `CalibrationError`, `LimitError`, `RigError`, `SignalInterrupt`.
    """
    source = find_config_file("rig", rig)
    if answers[1]:
        _check_answers(*answers, points_kpa)
    require_rig_place(out, f"--out {out}")
    _require_within_limit(points_kpa, settings)
    terminal = Terminal()
    if not may_move:
        terminal.require_yes("the rig will be pressurised and may move; is everything clear of it?")
    require_backend(settings.rig)
    with open_workplace(settings) as bench:
        outcome = work(bench, PreparedAnswers(answers[1]) if answers[1] else terminal)
    text = _make_rig_file(out, source, outcome, what)
    failure = None
    try:
        write_files({out: text})
    except NewFileError as error:  # the values must not be lost with the file
        failure = error
    return _report(outcome, settings, None if failure else out), failure


def _check_answers(option: str, values: Sequence[float], points: Sequence[float]) -> None:
    """Raise `ConfigError` where answers given by an option do not fit.

    Called before anything moves: a rig is not pressurised for a number that no instrument shows.
    """
    if len(values) != len(points):
        message = f"values: {len(values)}, points: {len(points)}; give --point as often"
        raise ConfigError([Problem(option, "", message)])
    for value in values:
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigError([Problem(option, "", f"must be above 0 (got {value:g})")])


def require_rig_place(path: Path, where: str) -> None:
    """Raise `ConfigError` or `NewFileError` unless a new rig file can be written there."""
    if path.suffix not in {".yaml", ".yml"}:
        message = "must end in .yaml, for --rig to take it as a file"
        raise ConfigError([Problem(where, "", message)])
    require_place(path)


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
    text = insert_values(
        source.read_text(encoding="utf-8"), outcome.values, (heading, *outcome.notes)
    )
    validate_settings(SECTIONS["rig"], RawSettings.parse(text, out), title="rig")
    return text


def _report(outcome: CalibrationOutcome, settings: RunSettings, out: Path | None) -> Report:
    """Return what was found: each value beside the one before; the document has the file's keys."""
    before = settings_to_data(settings.rig)
    found = {}
    for value in outcome.values:
        section, key = value.keys
        within = f" +- {value.uncertainty:.2g}" if value.uncertainty else ""
        was = before.get(section, {}).get(key)
        found[f"{section}.{key}"] = (
            f"{value.value:.7g}{within} {value.unit} (was {was:.7g}): {value.how}"
        )
    document = {
        "exit_code": int(ExitCode.OK),
        "reason": "",
        "values": [{**v._asdict(), "keys": ".".join(v.keys)} for v in outcome.values],
        "rig_file": str(out) if out else None,
        "notes": list(outcome.notes),
        "figures": dict(outcome.figures),
    }
    verdict = f"rig file: {shorten_path(out)}" if out else "no rig file"
    report = Report("Calibration", verdict, document=document)
    return report.add(Facts(found), *map(Text, outcome.notes))


class CalibrationOutcome(NamedTuple):
    """All that a calibration found."""

    values: tuple[RigValue, ...]
    notes: tuple[str, ...]
    """Facts that have no key in the file: they become dated comments."""
    figures: Mapping[str, object]
    """What the values rest on: points, residuals, noise; SI, units in the names."""


class CalibrationError(Exception):
    """A measurement or an answer makes no sense; the message says why and what to check."""

    exit_code = ExitCode.CHECK_FAILED


class PreparedAnswers:
    """Answers given in advance, in the order of the questions: for scripts."""

    def __init__(self, answers: Sequence[float]) -> None:
        self._answers = list(answers)

    def wait(self, request: str, idle: Callable[[], object]) -> None:
        """Let the rig go on for a moment, then go on as if it were done."""
        for _ in range(30):
            idle()

    def number(self, question: str, idle: Callable[[], object]) -> float:
        """Let the rig go on for a moment, then give the next answer."""
        self.wait(question, idle)
        if not self._answers:
            raise CalibrationError(f"no value was given for: {question}")
        return self._answers.pop(0)


Operator = Terminal | PreparedAnswers
"""The person at the rig. What is called while an answer is awaited keeps the rig going."""

_AVERAGED, _IDLE = 500, 20
"""Samples that a reading is the mean of, and those between two looks at the person."""


def read_while_held(
    bench: Bench, operator: Operator, point_kpa: float, question: str
) -> tuple[SensorStatistics, float]:
    """Hold a pressure (kPa gauge) until the question is answered.

    Returns what the sensors read just before the answer, and the answer. Raises `LimitError` where
    the pressure cannot be reached.
    """
    target_pa = bench.absolute_pa(point_kpa)
    bench.bring_to_pressure(target_pa)
    latest: deque[RawSample] = deque(maxlen=_AVERAGED)

    def hold_on() -> None:
        latest.extend(bench.hold_pressure(target_pa, lambda samples: len(samples) >= _IDLE))

    answer = operator.number(f"about {point_kpa:g} kPa: {question}", hold_on)
    while len(latest) < _AVERAGED:
        hold_on()
    return summarise_samples(latest), answer


class RigValue(NamedTuple):
    """One value for the rig file, with its uncertainty."""

    keys: tuple[str, str]
    """Section and key."""
    value: float
    unit: str
    uncertainty: float
    """Two standard deviations, of one measurement alone; 0 for what is exact."""
    how: str


def insert_values(text: str, values: Sequence[RigValue], notes: Sequence[str]) -> str:
    """Return the text of a rig file with values put in.

    The notes become comments at the top; the first begins with the date and gives the command and
    the source file. A comment above each value says how it was found.
    """
    wanted = _change_data(parse_yaml(text, Path("rig file")).data, values)
    edited = text
    for value in values:
        edited = _edit_line(edited, value, notes[0])
    found: object = None
    with suppress(YamlError):
        found = parse_yaml(edited, Path("rig file")).data
    if found != wanted:  # written in a way that lines cannot follow: flow style, anchors
        edited = dump_yaml(wanted)
    # The notes stand below the comments that the file begins with.
    lines = edited.splitlines()
    first = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    lines[first:first] = [f"# {note}" for note in notes]
    return "\n".join(lines) + "\n"


def _change_data(data: dict[str, object], values: Sequence[RigValue]) -> dict[str, Any]:
    changed: dict[str, Any] = copy.deepcopy(data)
    for value in values:
        section, key = value.keys
        changed[section] = {**(changed.get(section) or {}), key: value.value}
    return changed


def _edit_line(text: str, value: RigValue, heading: str) -> str:
    """Change or add one line, with a comment above it."""
    section, key = value.keys
    marks = parse_yaml(text, Path("rig file")).marks
    lines = text.splitlines()
    if value.keys in marks:
        at = marks[value.keys].line - 1
        old = re.match(rf"(\s*{key}\s*:\s*)([^\s#]*)(.*)", lines[at])
        if old is None:
            return text
        before, was, after = old.groups()
        indent = re.match(r"\s*", before)
        assert indent is not None
        comment = f"{indent[0]}# {_describe_value(value, heading)}; was {was}"
        lines[at : at + 1] = [comment, f"{before}{_format_value(value)}{after}"]
        return "\n".join(lines) + "\n"
    if (section,) not in marks:
        lines += [
            f"{section}:",
            f"  # {_describe_value(value, heading)}",
            f"  {key}: {_format_value(value)}",
        ]
        return "\n".join(lines) + "\n"
    at = marks[(section,)].line
    columns = [mark.column for at, mark in marks.items() if len(at) == 2 and at[0] == section]
    indent_text = " " * (min(columns, default=3) - 1)
    lines[at:at] = [
        f"{indent_text}# {_describe_value(value, heading)}; was the default",
        f"{indent_text}{key}: {_format_value(value)}",
    ]
    return "\n".join(lines) + "\n"


def _describe_value(value: RigValue, heading: str) -> str:
    date = heading.split(maxsplit=1)[0]
    within = f", +-{value.uncertainty:.2g} {value.unit}" if value.uncertainty else ""
    return f"{date}: {value.how}{within}"


def _format_value(value: RigValue) -> str:
    return f"{value.value:d}" if isinstance(value.value, int) else repr(value.value)
