"""The description of a run, known before its first tick: stored in the ring and in the log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from pamctl.json_text import from_json, to_json
from pamctl.signals import TICK_FIELDS, Field

_KINDS: dict[str, type] = {"int": int, "float": float, "bool": bool}


@dataclass(frozen=True)
class RunMeta:
    """Everything that is needed beside the ring's rows to write a complete log."""

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
