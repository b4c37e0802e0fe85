"""Names of log files: date, time and subject."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path


def make_dated_path(directory: Path, what: str) -> Path:
    """Return a path in `directory` that does not exist yet."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    names = (f"{stamp}{again}-{what}.mcap" for again in ("", *range(-2, -100, -1)))
    return next(path for name in names if not (path := directory / name).exists())


def flight_record_path(log: Path) -> Path:
    """Return the path of the flight record beside a log."""
    return log.with_name(f"{log.stem}-trip.csv")


def bare_name(name: str) -> str:
    """Return the bare name of a shipped name or a path; `.25` in `square-0.25` is no suffix."""
    last = Path(name).name
    return last.removesuffix(".yaml").removesuffix(".yml")


def file_safe_name(name: str) -> str:
    """Return the bare name of a file, with characters that are safe in any file name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", bare_name(name)).strip("._-")[:60] or "unnamed"
