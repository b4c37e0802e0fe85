"""Which runs are meant, and how they are listed: as a report and as CSV."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import Any

from pamctl.exit_codes import ExitCode
from pamctl.plain_text import hint_at_nearest
from pamctl.report.report import Report, ReportTable
from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_row import ENDING_WORDS, RunRow, find_varying_keys, read_value

_OPERATORS = {">": ">", "<": "<", ">=": ">=", "<=": "<=", "=": "=", "==": "=", "!=": "!="}
_WHERE = re.compile(r"\s*([A-Za-z_][\w.-]*)\s*(>=|<=|!=|==|=|>|<)\s*(.*?)\s*")
_NUMBERS = [one.name for one in fields(RunRow) if str(one.type).startswith(("int", "float"))]
_TEXTS = [one.name for one in fields(RunRow) if one.type == "str"]

Condition = tuple[str, list[object]]
"""SQL, and the values of its question marks."""


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


def select_runs(index: RunIndex, wanted: RunFilter, *, with_gains: bool = True) -> list[RunRow]:
    """Return the runs that are wanted, the oldest first; raise FilterError."""
    parts = list(_list_conditions(index, wanted))
    where = " AND ".join(f"({sql})" for sql, _ in parts) or "1"
    values = [value for _, more in parts for value in more]
    rows = index.select(where, values, with_gains=with_gains)
    return rows[-wanted.last :] if wanted.last else rows


def _list_conditions(index: RunIndex, wanted: RunFilter) -> Iterator[Condition]:
    for tag in wanted.tags:
        yield "EXISTS (SELECT 1 FROM json_each(tags) WHERE value = ?)", [tag]
    if wanted.since_s is not None:
        yield "when_s >= ?", [wanted.since_s]
    for text in wanted.where:
        yield _compare_key(index, text)


def _compare_key(index: RunIndex, text: str) -> Condition:
    found = _WHERE.fullmatch(text)
    if not found or not found[3]:
        examples = "law=qsmc, 'rms_um<20' or 'controller.lambda_per_s>=40'"
        raise FilterError(f"--where {text!r}: write a key, a comparison and a value: {examples}")
    key, operator, asked = found[1], _OPERATORS[found[2]], found[3]
    if key in _TEXTS:
        return _match_text(key, operator, asked, text)
    if key in _NUMBERS:
        return f"{key} {operator} ?", [_read_number(asked, text)]
    place = f'$."{key}"'
    value = "coalesce(json_extract(sweep, '$.point' || substr(?, 2)), json_extract(gains, ?))"
    if not index.holds_any(f"{value} IS NOT NULL", [place, place]):
        raise FilterError(f"--where {text!r}: no run has {key}{_suggest_key(index, key)}")
    try:
        return f"{value} {operator} ?", [place, place, float(asked)]
    except ValueError:
        if operator not in ("=", "!="):
            raise FilterError(f"--where {text!r}: {asked!r} is no number") from None
        return f"{value} {operator} ?", [place, place, asked]


def _match_text(key: str, operator: str, asked: str, text: str) -> Condition:
    """Compare in any case; `*` stands for any part, and only `*` and `?` are special."""
    if operator not in ("=", "!="):
        raise FilterError(f"--where {text!r}: {key} is a text; compare it by = or !=")
    if key == "ending" and not {*asked} & {*"*?"} and asked not in ENDING_WORDS:
        raise FilterError(f"--where {text!r}: an ending is one of {', '.join(ENDING_WORDS)}")
    negation = "NOT " if operator == "!=" else ""
    return f"lower({key}) {negation}GLOB lower(?)", [asked.replace("[", "[[]")]


def _read_number(part: str, text: str) -> float:
    try:
        return float(part)
    except ValueError:
        raise FilterError(f"--where {text!r}: {part!r} is no number") from None


def _suggest_key(index: RunIndex, key: str) -> str:
    known = {name for row in index.select() for name in row.gains}
    return hint_at_nearest(key, [*sorted(known), *_NUMBERS, *_TEXTS])


_HEADER = (
    *("start", "law", "experiment", "ending", "s", "max, µm", "RMS, µm", "steady, µm"),
    "log  [tags] note",
)
_MOST_NOTE = 60


def report_runs(rows: Sequence[RunRow], total: int, folder: Path) -> Report:
    """Return a table, the newest run last, and how many of how many runs they are."""
    report = Report(
        f"Runs of {folder}",
        f"{len(rows)} of {total} runs",
        document={"logs": str(folder), "runs": [*map(_make_document, rows)], "of": total},
    )
    return report.add(ReportTable(_HEADER, [*map(_make_cells, rows)])) if rows else report


def _make_document(row: RunRow) -> dict[str, Any]:
    return {"start": datetime.fromtimestamp(row.when_s, UTC).isoformat(), **vars(row)}


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
