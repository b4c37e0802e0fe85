"""Read a log: every column of its ticks as an array, all else as plain values.

A log that another version wrote is read by the descriptor it carries, or refused
with the reason: never misread. Every checksum in the file is checked.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from numpy.typing import NDArray

from pamctl.log.records import (
    Damage,
    LogError,
    Record,
    making_sense,
    mapped,
    record_at,
    unpack,
    verify,
    walk,
)
from pamctl.log.schema import EVENT_TOPIC, GAINS_TOPIC, KEYFRAME_TOPIC, TICK_TOPIC, unit_of
from pamctl.log.text import from_json
from pamctl.log.ticks import TickRuns
from pamctl.log.wire import UnknownLayout
from pamctl.signals import Phase

__all__ = ["Log", "LogError", "info", "read"]


@dataclass(frozen=True)
class Log:
    """A log in memory: `log["position_m"]` is a column of its ticks, of shape (n,)."""

    path: Path
    columns: Mapping[str, NDArray[Any]]
    """Every column of a tick, in the order of the log's own schema."""
    time_ns: NDArray[np.uint64]
    """Wall time of each tick."""
    units: Mapping[str, str]
    """The unit of each column."""
    events: list[dict[str, Any]]
    gains: list[dict[str, Any]]
    keyframes: list[dict[str, Any]]
    """Frozen states: `tick`, and `state` by name."""
    config: dict[str, Any]
    """The resolved configuration of the run."""
    attachments: Mapping[str, bytes]
    metadata: Mapping[str, Mapping[str, str]]
    counts: Mapping[str, int]
    """Messages in the file by topic."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column; raise LogError, with the nearest name, if there is none."""
        if name in self.columns:
            return self.columns[name]
        near = difflib.get_close_matches(name, self.columns, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise LogError(f"{self.path} has no column {name}{hint}")

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.time_ns)

    @property
    def t(self) -> NDArray[np.float64]:
        """Seconds since the first tick, shape (n,)."""
        return self["t_s"]


def read(path: str | Path, *topics: str) -> Log:
    """Read a log, or only these of its topics; raise LogError if any of the file is damaged."""
    log, damage = _scan(Path(path), topics)
    if damage is not None and damage.offset == 0:
        raise LogError(f"{path} is no log: {damage}")
    if damage is not None:
        raise LogError(
            f"{path} is damaged: {damage}; "
            f"save what is whole with `pamctl log recover {path} DESTINATION`"
        )
    if TICK_TOPIC in (topics or (TICK_TOPIC,)) and not log.columns:
        raise LogError(f"{path} is no log of pamctl: it has no channel {TICK_TOPIC}")
    return log


def info(path: str | Path) -> dict[str, Any]:
    """Summarise a log as far as it is whole; raise LogError if nothing of it is."""
    path = Path(path)
    log, damage = _scan(path, ())
    if damage is not None and not log.metadata:
        raise LogError(f"{path} is no log, or nothing of it is left: {damage}")
    ticks, size = len(log), path.stat().st_size
    run, origin = log.metadata.get("run", {}), log.metadata.get("pamctl", {})
    return {
        "path": str(path),
        "complete": damage is None,
        "damage": damage and str(damage),
        "bytes": size,
        "bytes_per_tick": size / ticks if ticks else None,
        "ticks": ticks,
        "duration_s": float(log.t[-1] - log.t[0]) if ticks else 0.0,
        **_gaps(log),
        "phases": _phases(log),
        "channels": dict(log.counts),
        **{key: run.get(key) for key in ("law", "controller", "experiment", "plant", "backend")},
        "seed": log.config.get("seed"),
        "timing_setup": dict(log.metadata.get("timing_setup", {})),
        **{key: origin.get(key) for key in ("version", "host", "start")},
        "outcome": next((e for e in reversed(log.events) if e.get("event") == "outcome"), None),
    }


def _gaps(log: Log) -> dict[str, int]:
    skipped = np.diff(log.columns.get("tick", np.zeros(0, int))) - 1
    return {"gaps": int(np.count_nonzero(skipped)), "missed_ticks": int(skipped.sum())}


def _phases(log: Log) -> dict[str, int]:
    """Return the ticks spent in each phase."""
    phases, counts = np.unique(log.columns.get("phase", np.zeros(0, int)), return_counts=True)
    names = {phase.value: phase.name.lower() for phase in Phase}
    return {
        names.get(phase, str(phase)): count
        for phase, count in zip(phases.tolist(), counts.tolist(), strict=True)
    }


def _scan(path: Path, topics: tuple[str, ...]) -> tuple[Log, Damage | None]:
    """Read up to the first damage, and return that too."""
    contents = _Contents(topics)
    try:
        damage = _fill(contents, mapped(path))
        return contents.log(path), damage
    except UnknownLayout as error:
        raise LogError(f"{path} was written by a version we cannot read: {error}") from error


def _fill(contents: _Contents, file: memoryview) -> Damage | None:
    try:
        for record in walk(file):
            with making_sense(record):
                verify(file, record)
                contents.take(file[: record.end], record)
    except Damage as damage:
        return damage
    return None


class _Contents:
    """What a log holds, as its records come by."""

    def __init__(self, topics: tuple[str, ...]) -> None:
        self._topics = topics
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._ticks: dict[int, TickRuns] = {}
        self._values: dict[str, list[dict[str, Any]]] = {
            topic: [] for topic in (EVENT_TOPIC, GAINS_TOPIC, KEYFRAME_TOPIC)
        }
        self._counts: Counter[str] = Counter()
        self._attachments: dict[str, bytes] = {}
        self._metadata: dict[str, dict[str, str]] = {}

    def take(self, data: memoryview, record: Record) -> int:
        """Take a record within `data`, with those alike behind it; return where they end."""
        match record.opcode:
            case Opcode.CHUNK:
                inside, at = unpack(record), 0
                while at < len(inside):
                    at = self.take(inside, record_at(inside, at))
            case Opcode.MESSAGE:
                return self._message(data, record)
            case Opcode.SCHEMA:
                schema = Schema.read(record.stream())
                self._schemas[schema.id] = schema
            case Opcode.CHANNEL:
                self._channel(Channel.read(record.stream()))
            case Opcode.ATTACHMENT:
                attachment = Attachment.read(record.stream())
                self._attachments[attachment.name] = attachment.data
            case Opcode.METADATA:
                metadata = Metadata.read(record.stream())
                self._metadata[metadata.name] = metadata.metadata
        return record.end

    def _channel(self, channel: Channel) -> None:
        self._channels[channel.id] = channel
        if channel.topic != TICK_TOPIC or channel.id in self._ticks:
            return
        if self._ticks or channel.message_encoding != "protobuf":
            raise UnknownLayout(f"{TICK_TOPIC} is not one channel of protobuf messages")
        self._ticks[channel.id] = TickRuns(self._schemas[channel.schema_id])

    def _message(self, data: memoryview, record: Record) -> int:
        channel = self._channels[int.from_bytes(record.body[:2], "little")]
        if channel.id in self._ticks:
            keep = self._wants(TICK_TOPIC)
            ticks, end = self._ticks[channel.id].take(data, record, keep=keep)
            self._counts[channel.topic] += ticks
            return end
        self._counts[channel.topic] += 1
        if channel.topic in self._values and self._wants(channel.topic):
            message = Message.read(record.stream(), len(record.body))
            self._values[channel.topic].append(from_json(message.data))
        return record.end

    def _wants(self, topic: str) -> bool:
        return topic in (self._topics or (topic,))

    def log(self, path: Path) -> Log:
        runs = next(iter(self._ticks.values()), None) if self._wants(TICK_TOPIC) else None
        columns = {} if runs is None else runs.columns()
        return Log(
            path=path,
            columns=columns,
            time_ns=np.zeros(0, np.uint64) if runs is None else runs.times(),
            units={name: unit_of(name) for name in columns},
            events=self._values[EVENT_TOPIC],
            gains=self._values[GAINS_TOPIC],
            keyframes=self._values[KEYFRAME_TOPIC],
            config=from_json(self._attachments.get("config.json", b"{}")),
            attachments=self._attachments,
            metadata=self._metadata,
            counts=dict(self._counts),
        )
