"""Check a log: read all of it strictly, and compare it with its clock and its story.

Memory use is bounded, however long the log is. An imported log is checked in the same way, but
it needs no configuration and no outcome. https://mcap.dev/spec
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partialmethod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.base.errors import Problem
from pamctl.base.texts import count_of, escape_name, from_json
from pamctl.log.framing import LogError
from pamctl.log.measured_signals import (
    describe_unknown_phase,
    find_signal_problems,
    find_unknown_phase,
)
from pamctl.log.reader import Scan
from pamctl.log.record_walk import Hole
from pamctl.log.row_problems import RecordProblem, find_tick_period_s, judge_first_tick
from pamctl.log.schema import (
    CUT,
    EVENT_TOPIC,
    IMPORTED_QUANTITIES,
    SCHEMA_VERSION,
    TICK_TOPIC,
    unit_of_column,
)
from pamctl.log.wire import SEQUENCE, TickBatch, UnknownLayout
from pamctl.signals import TICK_FIELDS

MOST_OF_A_KIND = 5
"""Findings of one kind that are listed one by one; the rest is only counted."""
CLOCK_TOLERANCE_S = 1e-6
"""Two clocks of one log differ by rounding: nanoseconds, and doubles over hours."""

ConfigCheck = Callable[[str], Sequence[str]]
"""Returns the problems of a resolved configuration, one sentence each."""


_RECOVER = "save all that is whole: pamctl log recover {} NEW.mcap"
_CUT = "cut a sound part out: pamctl log cut {} --out PART.mcap --from-s ... --to-s ..."
_ANEW = "make a log of what was measured anew: pamctl log export {} T.csv, then log import"
FIXES = {
    "damage": _RECOVER,
    **dict.fromkeys(("backwards", "duplicated", "phase", "empty", "missing"), _CUT),
    **dict.fromkeys(("tick-order", "clock", "gap", "sequence", "reversed", "columns"), _ANEW),
    "version": "read it with the version that wrote it, which is in the file's metadata",
    "units": "export the ticks, and import them with the right units: pamctl log export {} T.csv",
    "schema": "export the ticks for other tools: pamctl log export {} NEW.csv",
    "config": "replay it with the version that wrote it, which pamctl log info {} names",
}
"""What to do about errors, by their kind."""


class Severity(StrEnum):
    """The severity of a finding."""

    ERROR = "error"
    """The file is wrong, or holds impossible values."""
    WARNING = "warning"
    """A user of the file should know this, but the file is usable."""
    NOTE = "note"
    """Nothing is wrong, but it is worth mentioning."""


@dataclass
class LogFindings:
    """All findings, in the order in which they were made."""

    all: list[Problem] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)
    """Number of findings of each kind, listed or not."""

    def add(self, severity: Severity, kind: str, message: str) -> None:
        """Add a finding."""
        self.kinds[kind] += 1
        if self.kinds[kind] <= MOST_OF_A_KIND:
            self.all.append(Problem("", kind, message, severity))

    error = partialmethod(add, Severity.ERROR)
    warning = partialmethod(add, Severity.WARNING)
    note = partialmethod(add, Severity.NOTE)

    def errors(self, kind: str, rows: NDArray[np.intp], describe: Callable[[int], str]) -> None:
        """Add an error for each of these rows; only those that are listed are described."""
        for row in rows[:MOST_OF_A_KIND].tolist():
            self.error(kind, describe(row))
        self.kinds[kind] += len(rows[MOST_OF_A_KIND:])
        if not self.kinds[kind]:
            del self.kinds[kind]

    def summarise(self) -> list[Problem]:
        """Return the findings, and for each kind with too many the number of the rest."""
        weights = {finding.key: finding.level for finding in self.all}
        rest = (
            Problem("", kind, f"and {count - MOST_OF_A_KIND} more of these", weights[kind])
            for kind, count in self.kinds.items()
            if count > MOST_OF_A_KIND
        )
        return [*self.all, *rest]

    def any(self, severity: Severity) -> bool:
        """Tell whether there is a finding of this severity."""
        return any(finding.level == severity for finding in self.all)

    def soften(self, kind: str) -> None:
        """Turn errors of a kind into warnings: something else explains them."""
        self.all = [
            finding._replace(level=Severity.WARNING) if finding.key == kind else finding
            for finding in self.all
        ]


def list_findings(findings: Iterable[Problem]) -> list[dict[str, str]]:
    """Return findings as a document, and a log, have them."""
    return [{"severity": f.level, "kind": f.key, "message": f.message} for f in findings]


@dataclass(frozen=True)
class LogCheckReport:
    """The findings in one log."""

    path: str
    ticks: int
    findings: tuple[Problem, ...]

    @property
    def ok(self) -> bool:
        """Whether there are no errors."""
        return all(finding.level != Severity.ERROR for finding in self.findings)


def check_log(
    path: str | Path, problems_of_config: ConfigCheck = lambda text: ()
) -> LogCheckReport:
    """Check a log; raise LogError if the file is not a log at all."""
    findings = LogFindings()
    ticks = _TickCheck(findings)
    scan = _CheckScan(path, findings, ticks)
    try:
        scan.read_records()
    except UnknownLayout as error:
        findings.error("version", f"written by a version that cannot be read: {error}")
    if scan.ticks is None and not findings.any(Severity.ERROR):
        raise LogError(f"{path} is not a log of pamctl: it has no channel {TICK_TOPIC}")
    ticks.end()
    _check_schema(scan, findings)
    _check_story(scan, findings, problems_of_config)
    problems = findings.summarise()
    for at, finding in enumerate(problems):
        if finding.level == Severity.ERROR:
            fix = FIXES.get(finding.key, "").format(escape_name(str(path)))
            problems[at] = finding._replace(fix=fix)
    return LogCheckReport(str(path), ticks.count, tuple(problems))


class _CheckScan(Scan):
    """A scan that goes on behind damage."""

    def __init__(self, path: str | Path, findings: LogFindings, ticks: _TickCheck) -> None:
        super().__init__(path, (EVENT_TOPIC, TICK_TOPIC), take_ticks=ticks.take)
        self._findings = findings

    def lose(self, hole: Hole) -> None:
        if hole.damage.offset == 0:
            raise LogError(f"{self.path} is not a log: {hole.damage}")
        self._findings.error("damage", str(hole.damage))


_NEEDED = ("tick", "t_s", "dt_s", "missed")
PIECE_TICKS = 1 << 15
"""Ticks that are looked at together: half a minute at 1 kHz, however long the log is."""
_OF_THE_WHOLE = ("constant", "reversed")
"""Kinds of problems that mean nothing where they are not true of each piece."""


class _TickCheck:
    """Looks at the ticks piece by piece; the last tick of a piece begins the next one, too."""

    def __init__(self, findings: LogFindings) -> None:
        self._findings = findings
        self._parts: list[dict[str, NDArray[Any]]] = []
        self._waiting = self._pieces = self._first_row = 0
        self._problems: dict[tuple[str, str], list[RecordProblem]] = {}
        self._period_s = float("nan")
        self.count = self.missed = self.gaps = 0

    def take(self, batch: TickBatch) -> None:
        """Take the next ticks."""
        self.count += len(batch.sequence)
        if not all(name in batch.columns for name in _NEEDED):
            return
        self._check_phases(batch)
        names = [name for name in (*_NEEDED, *IMPORTED_QUANTITIES) if name in batch.columns]
        part = {name: np.array(batch.columns[name]) for name in names}
        self._parts.append({**part, "time_ns": batch.log_time_ns.astype(np.int64)})
        self._waiting += len(batch.sequence)
        if self._waiting >= PIECE_TICKS:
            self._check_piece()

    def _check_piece(self) -> None:
        ticks = {name: np.concatenate([p[name] for p in self._parts]) for name in self._parts[0]}
        rows = len(ticks["tick"])
        if not self._pieces:
            self._period_s = find_tick_period_s(ticks["tick"], ticks["t_s"])
            for problem in judge_first_tick(ticks["tick"], ticks["t_s"]):
                self._findings.error("tick-order", problem.describe())
        self._check_numbers(ticks)
        self._check_times(ticks)
        for problem in find_signal_problems(ticks):
            moved = tuple((a + self._first_row, b + self._first_row) for a, b in problem.stretches)
            found = self._problems.setdefault((problem.kind, problem.column), [])
            found.append(problem._replace(stretches=moved, share=problem.share * rows))
        self._pieces += 1
        self._first_row += rows - 1
        self._parts, self._waiting = [{name: c[-1:].copy() for name, c in ticks.items()}], 0

    def end(self) -> None:
        """Check the last piece, and report what all ticks together show."""
        if self._waiting:
            self._check_piece()
        for problem in self._join_problems():
            # A run may end before its first tick, and a rig may be at rest.
            severity = Severity.NOTE if problem.kind == "constant" else Severity.WARNING
            if problem.is_fatal and problem.kind != "short":
                severity = Severity.ERROR
            self._findings.add(severity, problem.kind, problem.describe())
        if self.missed:
            counted = f"missed: {self.missed} in {count_of(self.gaps, 'gap')}; the log counts them"
            self._findings.note("missed", counted)

    def _join_problems(self) -> list[RecordProblem]:
        """Return the problems of all pieces, each kind of a column once."""
        if not self._pieces:
            return find_signal_problems({"t_s": np.empty(0)})
        return [
            found[0]._replace(
                stretches=tuple(stretch for one in found for stretch in one.stretches),
                to_s=found[-1].to_s,
                share=sum(one.share for one in found) / (self._first_row + 1),
            )
            for (kind, _), found in self._problems.items()
            if len(found) == self._pieces or kind not in _OF_THE_WHOLE
        ]

    def _check_numbers(self, ticks: Mapping[str, NDArray[Any]]) -> None:
        tick = ticks["tick"]
        step, missed = np.diff(tick), ticks["missed"][1:]
        self.missed += int(missed.sum())
        self.gaps += int(np.count_nonzero(missed))
        self._findings.errors(
            "tick-order",
            np.flatnonzero(step <= 0),
            lambda i: f"tick {tick[i + 1]} follows tick {tick[i]}",
        )
        self._findings.errors(
            "gap",
            np.flatnonzero((step > 0) & (step - 1 != missed)),
            lambda i: (
                f"{count_of(step[i] - 1, 'tick')} missing between {tick[i]} and {tick[i + 1]}, "
                f"but the loop missed {missed[i]}"
            ),
        )

    @np.errstate(invalid="ignore")  # a time may be infinite
    def _check_times(self, ticks: Mapping[str, NDArray[Any]]) -> None:
        tick, dt_s, missed = ticks["tick"], ticks["dt_s"][1:], ticks["missed"][1:]
        step = np.diff(ticks["t_s"])
        wall = np.diff(ticks["time_ns"]) * 1e-9
        # After an uncounted gap, the time since the last tick in the file means nothing.
        whole = (np.diff(tick) - 1 == missed) & (step > 0) & np.isfinite(step)
        self._findings.errors(
            "clock",
            np.flatnonzero(whole & (np.abs(dt_s - step) > CLOCK_TOLERANCE_S)),
            lambda i: f"at tick {tick[i + 1]}, dt_s is {dt_s[i]}, but t_s advanced by {step[i]}",
        )
        self._findings.errors(
            "clock",
            np.flatnonzero(np.isfinite(step) & (np.abs(wall - step) > CLOCK_TOLERANCE_S)),
            lambda i: (
                f"at tick {tick[i + 1]}, log_time advanced by {wall[i]} s, but t_s by {step[i]}"
            ),
        )
        periods = dt_s / self._period_s - (1 + missed)
        for i in np.flatnonzero(whole & ~(np.abs(periods) <= 1.0)).tolist():
            detail = f"dt_s is {dt_s[i]}, with {count_of(missed[i], 'missed tick')}"
            self._findings.warning("period", f"at tick {tick[i + 1]}, {detail}")

    def _check_phases(self, batch: TickBatch) -> None:
        tick = batch.columns["tick"]
        differs = tick & SEQUENCE != batch.sequence
        if differs.any():
            at = int(tick[differs.argmax()])
            detail = f"tick {at} differs from the sequence number of its message"
            self._findings.error("sequence", detail)
        phase = batch.columns.get("phase", np.empty(0, np.int64))
        unknown = find_unknown_phase(phase)
        if unknown is not None and "phase" not in self._findings.kinds:
            at = int(tick[(phase == unknown).argmax()])
            self._findings.error("phase", f"from tick {at} on, {describe_unknown_phase(unknown)}")


def _check_schema(scan: Scan, findings: LogFindings) -> None:
    """Check that the ticks have the expected columns, each with its unit."""
    if scan.ticks is None:
        return
    channel = scan.channels[scan.tick_channel]
    for problem in scan.schema_problems():
        findings.error(problem.kind, problem.describe())
    written = channel.metadata.get("schema_version", "")
    version = int(written) if written.isdecimal() else 0
    try:
        stated = dict(from_json(channel.metadata.get("units", "{}")))
    except (ValueError, TypeError) as error:
        findings.error("units", f"the metadata of {TICK_TOPIC} makes no sense: {error}")
        return
    for name, column in scan.ticks.none.items():
        unit = unit_of_column(name)
        if column.dtype.kind == "f" and unit == "1":
            findings.error("units", f"the name of {name} states no unit")
        elif stated.get(name) != unit:
            findings.error(
                "units", f"{name} is stated in {stated.get(name)}, but its name says {unit}"
            )
    if version > SCHEMA_VERSION:
        findings.warning("version", f"schema {version} is newer than this pamctl's")
    known = [field.name for field in TICK_FIELDS] if version == SCHEMA_VERSION else _NEEDED
    for name in _NEEDED if scan.is_imported else known:
        if name not in scan.ticks.none:
            findings.error("columns", f"there is no column {name}")


def _check_story(scan: Scan, findings: LogFindings, problems_of_config: ConfigCheck) -> None:
    """Check everything beside the ticks: repair, origin, configuration, outcome."""
    recovery = scan.metadata.get("recovery")
    if recovery is not None:
        lost = recovery.get("lossless") == "false"
        detail = f"the log was recovered: {recovery.get('damage') or 'nothing was lost'}"
        (findings.warning if lost else findings.note)("recovered", detail)
        if lost:
            findings.soften("gap")
        if recovery.get("unverified"):
            detail = f"no checksum covers the metadata {recovery['unverified']}"
            findings.warning("unverified", detail)
    cut = scan.metadata.get(CUT)
    if cut is not None:
        where = f"rows {cut.get('first_row')} to {cut.get('last_row')}"
        findings.note("cut", f"cut from {cut.get('source')}, {where} of {cut.get('source_rows')}")
    if scan.is_imported:
        source = scan.metadata.get("import", {}).get("source", "an unknown source")
        findings.note("imported", f"imported from {source}: it has no configuration and no outcome")
        return
    text = scan.attachments.get("config.json")
    if text is None:
        say = findings.warning if recovery is not None else findings.error
        say("config", "no configuration is attached: the run cannot be replayed")
    else:
        for problem in problems_of_config(text.decode(errors="replace")):
            findings.error("config", problem)
    if scan.outcome is None and cut is None:
        findings.warning("outcome", "no outcome: the log does not say how the run ended")
