"""One pass over a log for all who read: ticks are passed on in batches, all else is kept.

Every checksum is verified. `read` collects the ticks in memory, `read_paged` leaves them in the
file, `info` counts them, and `check.py` looks at each of them.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from numpy.typing import NDArray

from pamctl.json_text import from_json
from pamctl.log.columns import WALL_TIME, TickColumns
from pamctl.log.framing import Damage, FileRecord, LogError, map_log_file
from pamctl.log.reading.record_walk import (
    MOST_SILENT_BYTES,
    Hole,
    Loaded,
    MessageRun,
    load_records,
    parse_messages,
)
from pamctl.log.record_problems import RecordProblem, judge_schema
from pamctl.log.schema import EVENT_TOPIC, GAINS_TOPIC, IMPORTED, KEYFRAME_TOPIC, TICK_TOPIC
from pamctl.log.wire import TickBatch, TickDecoder, UnknownLayout
from pamctl.plain_text import clean_document, escape_name

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
        ended = (e for e in reversed(self.values[EVENT_TOPIC]) if e.get("event") == "outcome")
        return next(ended, None)

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
