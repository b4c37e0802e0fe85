"""Read a log: the ticks as arrays by column, everything else as plain values.

`read` collects the ticks in memory, `read_paged` leaves them in the file, and `info` counts them.

A log of another version is read by the descriptor that it carries, or refused with the reason.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from numpy.typing import NDArray

from pamctl.base.texts import clean_document, escape_name, from_json, hint_at_nearest
from pamctl.log.columns import WALL_TIME, GridRows, Page, Pages, TickColumns
from pamctl.log.framing import (
    Damage,
    FileRecord,
    LogError,
    map_log_file,
    record_at,
    release_pages,
    translate_parse_errors,
)
from pamctl.log.record_walk import (
    MOST_SILENT_BYTES,
    Hole,
    Loaded,
    MessageRun,
    Unpacker,
    load_records,
    parse_messages,
)
from pamctl.log.row_problems import RecordProblem, judge_schema
from pamctl.log.run_meta import ANNOTATION, CHANGES, Annotation, describe_running_changes
from pamctl.log.schema import (
    CUT,
    EVENT_TOPIC,
    GAINS_TOPIC,
    IMPORTED,
    KEYFRAME_TOPIC,
    TICK_TOPIC,
    unit_of_column,
)
from pamctl.log.wire import TickBatch, TickDecoder, UnknownLayout
from pamctl.signals import Phase

__all__ = ["Log", "LogError", "NoSuchColumn", "Scan", "info", "read", "read_paged", "read_some"]


class NoSuchColumn(LogError):
    """A log has no column of that name; the message gives the nearest name."""


@dataclass(frozen=True)
class Log:
    """A log: `log["position_m"]` is a column of its ticks, shape (n,).

    In memory a column is an array. `read_paged` leaves the columns in the file.
    """

    path: Path
    columns: Mapping[str, NDArray[Any]]
    """The columns of the ticks, in the order of the log's own schema."""
    time_ns: NDArray[np.uint64]
    """Wall time of each tick."""
    units: Mapping[str, str]
    """The unit of each column."""
    events: list[dict[str, Any]]
    gains: list[dict[str, Any]]
    keyframes: list[dict[str, Any]]
    """Frozen states: `tick`, and the numbers of `state` by name."""
    config: dict[str, Any]
    """The resolved configuration of the run."""
    attachments: Mapping[str, bytes]
    metadata: Mapping[str, Mapping[str, str]]
    counts: Mapping[str, int]
    """Number of messages in the file, by topic."""
    is_imported: bool
    """Whether another system measured it: then it holds no controller to replay."""
    schema_problems: tuple[RecordProblem, ...] = ()
    """What is wrong with the description of the ticks."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column; raise LogError with the nearest name if there is none."""
        if name in self.columns:
            return self.columns[name]
        raise NoSuchColumn(f"{self.path} has no column {name}{hint_at_nearest(name, self.columns)}")

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.time_ns)

    @cached_property
    def grid(self) -> GridRows:
        """Which row holds which tick of the loop's grid."""
        if isinstance(self.columns, Pages):
            return self.columns.grid
        grid = GridRows()
        grid.take(self["tick"], self["missed"], self["t_s"])
        return grid

    @property
    def t(self) -> NDArray[np.float64]:
        """Seconds since the first tick, shape (n,)."""
        return self["t_s"]

    @property
    def outcome(self) -> dict[str, Any] | None:
        """The event that tells how the run ended; None if the log does not say it."""
        return _find_outcome(self.events)


def _find_outcome(events: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    return next((event for event in reversed(events) if event.get("event") == "outcome"), None)


def read(path: str | Path, *topics: str, fields: Collection[str] | None = None) -> Log:
    """Read a log, or only these topics, or only these fields of the ticks.

    Raise LogError if any part of the file is damaged, also a part that is not asked for.
    """
    scan = Scan(path, topics, fields).run().require_whole()
    for name in fields or ():
        if scan.ticks is not None and name not in scan.ticks.none:
            near = hint_at_nearest(name, scan.ticks.none)
            raise NoSuchColumn(f"{path} has no column {name}{near}")
    return _collect_log(scan)


def read_some(path: str | Path, fields: Collection[str], *topics: str) -> Log:
    """Read only these fields of the ticks, without those that the log lacks, and these topics.

    A long log takes a fraction of the time and memory then. Raise LogError as `read` does.
    """
    return _collect_log(Scan(path, topics, fields).run().require_whole())


def _collect_log(scan: Scan) -> Log:
    columns = scan.columns()
    times = columns.pop(WALL_TIME)
    return _make_log(scan, columns, times)


def _make_log(scan: Scan, columns: Mapping[str, NDArray[Any]], time_ns: NDArray[np.uint64]) -> Log:
    """Return the log of these columns, and of all else that was read."""
    return Log(
        path=scan.path,
        columns=columns,
        time_ns=time_ns,
        units={name: unit_of_column(name) for name in columns},
        events=scan.values[EVENT_TOPIC],
        gains=scan.values[GAINS_TOPIC],
        keyframes=scan.values[KEYFRAME_TOPIC],
        config=scan.config(),
        attachments=scan.attachments,
        metadata=scan.metadata,
        counts=dict(scan.counts),
        is_imported=scan.is_imported,
        schema_problems=scan.schema_problems(),
    )


def read_paged(path: str | Path) -> Log:
    """Read a log as `read` does, but leave its ticks in the file: an hour in little memory.

    A column is read as `column[i]`, `column[a:b]` or `np.asarray(column)`; then a page of ticks is
    decoded. The file must stay as it is while the log is in use. Raise LogError as `read` does.
    """
    grid = GridRows()

    def take(batch: TickBatch) -> None:
        if len(batch.columns) == len(needed):
            grid.take(*(batch.columns[name] for name in needed))

    needed = ("tick", "missed", "t_s")
    scan = Scan(path, fields=needed, take_ticks=take).run().require_whole()
    is_loose = any(chunk_at < 0 for _, chunk_at in scan.places)  # another program wrote it
    if is_loose or grid.count != scan.counts[TICK_TOPIC]:
        return read(path)
    assert scan.ticks is not None
    schema = scan.schemas[scan.channels[scan.tick_channel].schema_id]
    decoder = TickDecoder(schema.data, schema.name)

    def decode(places: Sequence[int], rows: int) -> Page:
        columns = TickColumns(decoder.none, rows)
        decoder.take = columns.take
        try:
            for at in places:
                record = record_at(scan.file, at)
                with translate_parse_errors(record):
                    *_, parts = Unpacker(scan.path, scan.file).unpack(record)
                for part in parts:
                    if isinstance(part, MessageRun) and part.channel == scan.tick_channel:
                        decoder.add(part.records)
                release_pages(scan.file, record.start, record.end)
            decoder.flush()
        except Damage as damage:
            raise LogError(f"{path} was changed while it was read: {damage}") from damage
        return columns.finish()

    pages = Pages(scan.ticks.none, scan.places, grid, decode)
    return _make_log(scan, pages, pages.time_ns)


def info(path: str | Path) -> dict[str, Any]:
    """Summarise the undamaged part of a log of any length; raise LogError if there is none."""
    grid, phases = GridRows(), Counter[int]()

    def take(batch: TickBatch) -> None:
        if {"tick", "t_s"} <= batch.columns.keys():
            tick = batch.columns["tick"]
            grid.take(tick, batch.columns.get("missed", np.zeros_like(tick)), batch.columns["t_s"])
        values, counts = np.unique(batch.columns.get("phase", []), return_counts=True)
        phases.update(dict(zip(values.tolist(), counts.tolist(), strict=True)))

    scan = Scan(path, fields=("tick", "missed", "t_s", "phase"), take_ticks=take).run()
    if scan.damage is not None and not scan.metadata:
        raise LogError(f"{path} is not a log, or nothing in it can be read: {scan.damage}")
    run, origin = scan.metadata.get("run", {}), scan.metadata.get("pamctl", {})
    size, ticks = len(scan.file), scan.counts[TICK_TOPIC]
    names = {phase.value: phase.name.lower() for phase in Phase}
    config: dict[str, Any] = {}
    with suppress(LogError):
        config = scan.config()
    said = Annotation.from_metadata(scan.metadata.get(ANNOTATION, {}))
    return {
        "path": str(path),
        "complete": scan.damage is None,
        "damage": scan.damage and str(scan.damage),
        "bytes": size,
        "bytes_per_tick": size / ticks if ticks else None,
        "ticks": ticks,
        "duration_s": grid.last_t_s - grid.first_t_s if grid.count else 0.0,
        "gaps": grid.gaps,
        "missed_ticks": grid.skipped,
        "phases": {names.get(phase, str(phase)): n for phase, n in sorted(phases.items())},
        "channels": dict(scan.counts),
        "origin": IMPORTED if scan.is_imported else "recorded",
        "source": scan.metadata.get("import", {}).get("source"),
        "cut_from": _describe_cut(scan.metadata.get(CUT)),
        **{key: run.get(key) for key in ("law", "controller", "experiment", "plant", "backend")},
        **asdict(said),
        "tags": list(said.tags),
        CHANGES: run.get(CHANGES),
        "gains_while_running": describe_running_changes(scan.values[GAINS_TOPIC]),
        "seed": config.get("seed"),
        "timing_setup": dict(scan.metadata.get("timing_setup", {})),
        **{key: origin.get(key) for key in ("version", "host")},
        "start": None if scan.is_imported else origin.get("start"),
        "outcome": scan.outcome,
    }


def _describe_cut(cut: Mapping[str, str] | None) -> str | None:
    if cut is None:
        return None
    rows = f"rows {cut['first_row']} to {cut['last_row']} of {cut['source_rows']}"
    return f"{cut['source']}, {rows}, {float(cut['from_s']):.6g} to {float(cut['to_s']):.6g} s"


MOST_JSON_BYTES = 1 << 24
"""Events, gains and states that are read without a word, beside the bytes of the file itself."""


class Scan:
    """One pass over a log: all that is in it but the ticks, which are passed on in batches."""

    def __init__(
        self,
        path: str | Path,
        topics: Collection[str] = (),
        fields: Collection[str] | None = None,
        take_ticks: Callable[[TickBatch], None] | None = None,
    ) -> None:
        """Keep these topics and decode these fields of the ticks; by default all.

        `take_ticks` gets each batch of ticks; by default they are collected. Nothing is read before
        `run`. Raise LogError if there is no such file.
        """
        self.path = Path(path)
        self.file = map_log_file(self.path)
        self.damage: Damage | None = None
        """The first damage of the file."""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.ticks: TickDecoder | None = None
        self.tick_channel = -1
        """The number of the channel of the ticks."""
        self.places: list[tuple[int, int]] = []
        """Row of the first tick of each chunk, and where the chunk begins; -1: in no chunk."""
        self.values: dict[str, list[dict[str, Any]]] = {
            topic: [] for topic in (EVENT_TOPIC, GAINS_TOPIC, KEYFRAME_TOPIC)
        }
        """Messages by topic, without the ticks."""
        self.counts: Counter[str] = Counter()
        """Number of messages in the file, by topic."""
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self._topics, self._fields, self._take_ticks = topics, fields, take_ticks
        self._collected: TickColumns | None = None
        self._json_bytes = self._seen_bytes = 0
        self._has_said = False

    def run(self) -> Scan:
        """Read up to the first damage; raise LogError for a version that cannot be read."""
        try:
            self.read_records()
        except UnknownLayout as error:
            what = f"was written by a version that cannot be read: {error}"
            raise LogError(f"{self.path} {what}") from error
        return self

    def read_records(self) -> None:
        """Take all records, or those up to the first damage that `lose` raises."""
        try:
            try:
                load_records(self.path, self.file, self.take, self.lose)
            except Damage as damage:
                self.damage = damage
            if self.ticks is not None:
                self.ticks.flush()
        finally:
            if self.ticks is not None:
                self.ticks.take = None  # a circle would keep the file open

    def require_whole(self) -> Scan:
        """Raise LogError if any part of the file is damaged, or it has no ticks' channel."""
        if self.damage is not None and self.damage.offset == 0:
            raise LogError(f"{self.path} is not a log: {self.damage}")
        if self.damage is not None:
            raise LogError(
                f"{self.path} is damaged: {self.damage}; "
                f"save the undamaged part with `pamctl log recover {self.path} DESTINATION`"
            )
        if self.wants(TICK_TOPIC) and self.ticks is None:
            raise LogError(f"{self.path} is not a log of pamctl: it has no channel {TICK_TOPIC}")
        return self

    @property
    def is_imported(self) -> bool:
        """Whether another system measured it."""
        return any(c.metadata.get("origin") == IMPORTED for c in self.channels.values())

    @property
    def outcome(self) -> dict[str, Any] | None:
        """How the run ended; None if the log does not say it."""
        return _find_outcome(self.values[EVENT_TOPIC])

    def config(self) -> dict[str, Any]:
        """Return the configuration, empty if there is none; raise LogError if it is not JSON."""
        try:
            return dict(clean_document(from_json(self.attachments.get("config.json", b"{}"))))
        except (ValueError, TypeError) as error:
            raise LogError(f"the attachment config.json makes no sense: {error}") from error

    def schema_problems(self) -> tuple[RecordProblem, ...]:
        """Return what is wrong with the description of the ticks."""
        if self.ticks is None:
            return ()
        channel = self.channels[self.tick_channel]
        label = self.schemas[channel.schema_id].encoding
        return tuple(judge_schema(TICK_TOPIC, label, channel.metadata.get("schema_version", "")))

    def wants(self, topic: str) -> bool:
        """Tell whether to keep the messages of a topic."""
        return topic in (self._topics or (topic,))

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the columns that were collected, and `WALL_TIME`; empty ones without ticks."""
        if self._collected is None:
            return {WALL_TIME: np.zeros(0, np.uint64)}
        return self._collected.finish()

    def take(self, loaded: Loaded) -> None:
        """Take the next record of the file."""
        self._seen_bytes += max(len(loaded.content), len(loaded.record.body))
        chunk_at = loaded.record.start if loaded.chunk else -1
        for part in loaded.parts:
            if isinstance(part, MessageRun):
                self._take_run(part, chunk_at)
            else:
                self._take_record(part)

    def lose(self, hole: Hole) -> None:
        """Raise the damage: a strict reader reads on to no damage."""
        raise hole.damage

    def _take_record(self, record: FileRecord) -> None:
        match record.opcode:
            case Opcode.SCHEMA:
                schema = Schema.read(record.stream())
                self.schemas.setdefault(schema.id, schema)
            case Opcode.CHANNEL:
                self._take_channel(Channel.read(record.stream()))
            case Opcode.ATTACHMENT:
                attachment = Attachment.read(record.stream())
                self.attachments[attachment.name] = attachment.data
            case Opcode.METADATA:
                metadata = Metadata.read(record.stream())
                self.metadata[metadata.name] = clean_document(metadata.metadata)

    def _take_channel(self, channel: Channel) -> None:
        self.channels.setdefault(channel.id, channel)
        if channel.topic != TICK_TOPIC or channel.id == self.tick_channel:
            return
        if self.ticks is not None or channel.message_encoding != "protobuf":
            raise UnknownLayout(f"{TICK_TOPIC} is not one channel of protobuf messages")
        schema = self.schemas[channel.schema_id]
        self.ticks = TickDecoder(schema.data, schema.name, self._fields)
        self.tick_channel = channel.id
        if self.wants(TICK_TOPIC):
            self._collected = TickColumns(self.ticks.wanted)
            self.ticks.take = self._take_ticks or self._collect

    def _collect(self, batch: TickBatch) -> None:
        assert self._collected is not None
        self._collected.take(batch)
        held = self._collected.nbytes
        if held > MOST_SILENT_BYTES and not self._has_said:
            self._has_said = True
            what = f"the ticks of {escape_name(str(self.path))} take more than {held / 1e6:.0f} MB"
            shorter = "`pamctl log cut LOG --out SHORTER.mcap --to-s 600` makes a shorter one"
            sys.stderr.write(f"note: {what} of memory; {shorter}\n")
        if held > max(MOST_SILENT_BYTES, 2 * self._seen_bytes):
            what = f"take {held / 1e6:.0f} MB in memory, more than twice their bytes in the file"
            raise LogError(f"the ticks of {self.path} {what}: no run writes such ticks")

    def _take_run(self, run: MessageRun, chunk_at: int) -> None:
        topic = self.channels[run.channel].topic
        if self.ticks is not None and run.channel == self.tick_channel:
            if not self.places or self.places[-1][1] != chunk_at:
                self.places.append((self.counts[topic], chunk_at))
            self.ticks.add(run.records)
        elif topic in self.values and self.wants(topic):
            self._json_bytes += run.records.nbytes
            if self._json_bytes > MOST_JSON_BYTES + len(self.file):
                size = f"{self._json_bytes / 1e6:.0f} MB of {topic}"
                raise LogError(f"{self.path} unpacks to more than {size}: no run writes so many")
            self.values[topic] += [clean_document(m) for m in parse_messages(run.records)]
        self.counts[topic] += len(run.records)
