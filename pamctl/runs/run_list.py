"""Which runs are meant, and how they are listed: as a report and as CSV."""

from __future__ import annotations

import csv
import operator
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from pamctl.exit_codes import ExitCode
from pamctl.plain_text import hint_at_nearest
from pamctl.report.report import Report, ReportTable
from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_row import ENDING_WORDS, RunRow, find_varying_keys, read_value

_OPERATORS = {
    ">": operator.gt, "<": operator.lt, ">=": operator.ge, "<=": operator.le,
    "=": operator.eq, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip
_WHERE = re.compile(r"\s*([A-Za-z_][\w.-]*)\s*(>=|<=|!=|==|=|>|<)\s*(.*?)\s*")
_NUMBERS = [one.name for one in fields(RunRow) if str(one.type).startswith(("int", "float"))]
_TEXTS = [one.name for one in fields(RunRow) if one.type == "str"]


class FilterError(Exception):
    """An option that selects runs makes no sense. The message says what does."""

    exit_code = ExitCode.USAGE


@dataclass(frozen=True)
class RunFilter:
    """All that is given must hold."""

    tags: Sequence[str] = ()
    """All of them."""
    since_s: float | None = None
    """Seconds since the epoch."""
    where: Sequence[str] = ()
    """Conditions on columns and settings, such as `law=qsmc` or `controller.lambda_per_s>=40`."""
    last: int | None = None
    """Only the newest of them."""


def read_date(text: str) -> float:
    """Return a date such as `2026-11-20 14:30`, in the time zone of this PC, in epoch seconds.

    Raises FilterError.
    """
    try:
        return datetime.fromisoformat(text.strip()).timestamp()
    except (ValueError, OverflowError, OSError):
        message = f"--since {text!r}: write 2026-11-20 or '2026-11-20 14:30'"
        raise FilterError(message) from None


def select_runs(index: RunIndex, wanted: RunFilter) -> list[RunRow]:
    """Return the runs that are wanted, the oldest first; raise FilterError."""
    conditions = [_read_condition(text) for text in wanted.where]
    keys = [one.key for one in conditions if one.key not in (*_NUMBERS, *_TEXTS)]
    rows = index.select()
    for one in conditions:
        if one.key in keys and all(read_value(row, one.key) is None for row in rows):
            known = {name for row in rows for name in row.gains}
            hint = hint_at_nearest(one.key, [*sorted(known), *_NUMBERS, *_TEXTS])
            raise FilterError(f"--where {one.text!r}: no run has {one.key}{hint}")
    kept = [
        row
        for row in rows
        if {*wanted.tags} <= {*row.tags}
        and (wanted.since_s is None or row.when_s >= wanted.since_s)
        and all(one.holds(row) for one in conditions)
    ]
    return kept[-wanted.last :] if wanted.last else kept


class _Condition(NamedTuple):
    """A key, a comparison and a value; `text` is how the user wrote it."""

    text: str
    key: str
    operator: str
    asked: str | float

    def holds(self, row: RunRow) -> bool:
        """Tell whether it is true of a run; it is not where the run does not have the key."""
        if self.key in _TEXTS:  # in any case; `*` stands for any part, only `*` and `?` are special
            pattern = str(self.asked).lower().replace("[", "[[]")
            is_alike = fnmatchcase(getattr(row, self.key).lower(), pattern)
            return is_alike == (self.operator != "!=")
        value = getattr(row, self.key) if self.key in _NUMBERS else read_value(row, self.key)
        if value is None:
            return False
        if isinstance(value, str) != isinstance(self.asked, str):
            return self.operator == "!="
        return bool(_OPERATORS[self.operator](value, self.asked))


def _read_condition(text: str) -> _Condition:
    found = _WHERE.fullmatch(text)
    if not found or not found[3]:
        examples = "law=qsmc, 'rms_um<20' or 'controller.lambda_per_s>=40'"
        raise FilterError(f"--where {text!r}: write a key, a comparison and a value: {examples}")
    key, operator, asked = found.groups()
    is_equal = operator in ("=", "==", "!=")
    if key in _TEXTS:
        if not is_equal:
            raise FilterError(f"--where {text!r}: {key} is a text; compare it by = or !=")
        if key == "ending" and not {*asked} & {*"*?"} and asked not in ENDING_WORDS:
            raise FilterError(f"--where {text!r}: an ending is one of {', '.join(ENDING_WORDS)}")
        return _Condition(text, key, operator, asked)
    try:
        return _Condition(text, key, operator, float(asked))
    except ValueError:
        if not is_equal or key in _NUMBERS:
            raise FilterError(f"--where {text!r}: {asked!r} is no number") from None
        return _Condition(text, key, operator, asked)


_HEADER = (
    *("start", "law", "experiment", "ending", "s", "max, µm", "RMS, µm", "steady, µm"),
    "log  [tags] note",
)
_MOST_NOTE = 60


def report_runs(rows: Sequence[RunRow], total: int, folder: Path) -> Report:
    """Return a table, the newest run last, and how many of how many runs they are."""
    documents = [
        {"start": datetime.fromtimestamp(row.when_s, UTC).isoformat(), **vars(row)} for row in rows
    ]
    report = Report(
        f"Runs of {folder}",
        f"{len(rows)} of {total} runs",
        document={"logs": str(folder), "runs": documents, "of": total},
    )
    return report.add(ReportTable(_HEADER, [*map(_make_cells, rows)])) if rows else report


def _make_cells(row: RunRow) -> list[str]:
    start = datetime.fromtimestamp(row.when_s).strftime("%Y-%m-%d %H:%M:%S")
    errors = ("-" if v is None else f"{v:.1f}" for v in (row.max_um, row.rms_um, row.steady_um))
    tags = f"  [{' '.join(row.tags)}]" if row.tags else ""
    note = row.note if len(row.note) <= _MOST_NOTE else f"{row.note[: _MOST_NOTE - 3]}..."
    log = f"{row.path}{tags}{'  ' + note if note else ''}"
    return [start, row.law, row.experiment, row.ending, f"{row.duration_s:.1f}", *errors, log]


def format_csv(rows: Sequence[RunRow]) -> str:
    """Return every column, and a column for each setting that differs between the runs."""
    varying = find_varying_keys(rows, numbers_only=False)
    plain = [one.name for one in fields(RunRow) if one.name not in ("gains", "sweep")]
    text = StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["start", *plain, "sweep", *varying])
    for row in rows:
        start = datetime.fromtimestamp(row.when_s, UTC).isoformat(timespec="milliseconds")
        values = (" ".join(row.tags) if name == "tags" else getattr(row, name) for name in plain)
        settings = (read_value(row, key) for key in varying)
        table.writerow([start, *values, row.sweep.get("name", ""), *settings])
    return text.getvalue().rstrip("\n")
