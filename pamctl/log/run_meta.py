"""What is known of a run before its first tick: its description, and the name of its log."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pamctl.json_text import from_json, to_json
from pamctl.signals import TICK_FIELDS, Field

_KINDS: dict[str, type] = {"int": int, "float": float, "bool": bool}


@dataclass(frozen=True)
class RunMeta:
    """Everything that is needed beside the ring's rows to write a complete log.

    It is stored in the ring and in the log.
    """

    log_path: str
    """Path of the log; it must not exist yet."""
    start_wall_ns: int = 0
    """Time since the epoch at `start_mono_ns`; zero if there is no clock."""
    start_mono_ns: int = 0
    """The rig's monotonic clock at the start; the times in a log are relative to it."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """The resolved configuration; attached to the log as `config.json`."""
    attachments: Mapping[str, str] = field(default_factory=dict)
    """Text of further attachments by file name."""
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Metadata records by name: `run` holds `law`, `backend` and `experiment`."""
    keyframe_fields: Sequence[str] = ()
    """Names of the doubles of a keyframe, in order."""
    tick_fields: Sequence[Field] = TICK_FIELDS
    """Columns of a tick row, in order."""
    origin: str = ""
    """`pamctl.log.schema.IMPORTED` if another system measured the data, else empty."""

    def to_text(self) -> bytes:
        """Return as JSON."""
        columns = [(name, kind.__name__, stage) for name, kind, stage in self.tick_fields]
        known = {part.name: getattr(self, part.name) for part in fields(self)}
        return to_json({**known, "tick_fields": columns})

    @classmethod
    def from_text(cls, text: bytes) -> RunMeta:
        """Read what `to_text` wrote."""
        known = from_json(text)
        columns = (Field(name, _KINDS[kind], stage) for name, kind, stage in known["tick_fields"])
        return cls(**{**known, "tick_fields": tuple(columns)})


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
