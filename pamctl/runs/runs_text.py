"""Runs as a table for a terminal, as CSV, and as plain values for JSON."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from io import StringIO
from typing import Any

from pamctl.runs.run_row import RunRow
from pamctl.runs.varying import find_varying_keys, read_value

_HEADS = ("start", "law", "experiment", "ending", "s", "max um", "RMS um", "steady um")
_RIGHT = slice(4, 8)
_MOST_NOTE = 60


def format_runs(rows: Sequence[RunRow], total: int) -> str:
    """Return a table, the newest run last, and how many of how many runs they are."""
    cells = [_HEADS, *map(_format_row, rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    form = "  ".join(
        f"{{:{'>' if number in range(*_RIGHT.indices(99)) else '<'}{width}}}"
        for number, width in enumerate(widths)
    )
    ends = ["log  [tags] note", *map(_format_end, rows)]
    lines = [f"{form.format(*row)}  {end}" for row, end in zip(cells, ends, strict=True)]
    return "\n".join([*(lines if rows else ()), f"{len(rows)} of {total} runs"])


def _format_row(row: RunRow) -> tuple[str, ...]:
    start = datetime.fromtimestamp(row.when_s).strftime("%Y-%m-%d %H:%M:%S")
    errors = ("-" if v is None else f"{v:.1f}" for v in (row.max_um, row.rms_um, row.steady_um))
    return start, row.law, row.experiment, row.ending, f"{row.duration_s:.1f}", *errors


def _format_end(row: RunRow) -> str:
    tags = f"  [{' '.join(row.tags)}]" if row.tags else ""
    note = row.note if len(row.note) <= _MOST_NOTE else f"{row.note[: _MOST_NOTE - 3]}..."
    return f"{row.path}{tags}{'  ' + note if note else ''}"


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


def list_documents(rows: Iterable[RunRow]) -> list[dict[str, Any]]:
    """Return the rows as plain values."""
    return [
        {"start": datetime.fromtimestamp(row.when_s, UTC).isoformat(), **vars(row)} for row in rows
    ]
