"""Names of logs: when, and what."""

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
    """Return where the last seconds before a trip lie beside a log."""
    return log.with_name(f"{log.stem}-trip.csv")


def bare_name(name: str) -> str:
    """Return the name that a shipped name or a path means: `square-0.25` is no file ending."""
    last = Path(name).name
    return last.removesuffix(".yaml").removesuffix(".yml")


def file_safe_name(name: str) -> str:
    """Return the bare name of a file with nothing in it that another file's name cannot have."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", bare_name(name)).strip("._-")[:60] or "unnamed"
