"""Collect the contents of a log from its records. Files and damage are handled elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from pamctl.json_text import from_json
from pamctl.log.framing import FileRecord, LogError, record_at
from pamctl.log.schema import EVENT_TOPIC, GAINS_TOPIC, IMPORTED, KEYFRAME_TOPIC, TICK_TOPIC
from pamctl.log.ticks import TickBatch, TickDecoder
from pamctl.log.wire import UnknownLayout
from pamctl.plain_text import clean_document


class Contents:
    """Passes ticks on in batches, and keeps everything else, which is little."""

    def __init__(
        self,
        topics: Collection[str] = (),
        take_ticks: Callable[[TickBatch], None] | None = None,
        fields: Collection[str] | None = None,
    ) -> None:
        """Keep these topics and decode these fields of the ticks; by default all."""
        self._topics = topics
        self._take_ticks = take_ticks if self.wants(TICK_TOPIC) else None
        self._fields = fields
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.ticks: TickDecoder | None = None
        self.tick_channel = -1
        """The number of the channel of the ticks."""
        self.chunk_at = -1
        """Where in the file the chunk begins that is being taken; -1 outside of chunks."""
        self.values: dict[str, list[dict[str, Any]]] = {
            topic: [] for topic in (EVENT_TOPIC, GAINS_TOPIC, KEYFRAME_TOPIC)
        }
        """Messages by topic, without the ticks."""
        self.counts: Counter[str] = Counter()
        """Number of messages in the file, by topic."""
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    @property
    def is_imported(self) -> bool:
        """Whether another system measured it."""
        return any(c.metadata.get("origin") == IMPORTED for c in self.channels.values())

    def config(self) -> dict[str, Any]:
        """Return the configuration, empty if there is none; raise LogError if it is not JSON."""
        try:
            return dict(clean_document(from_json(self.attachments.get("config.json", b"{}"))))
        except (ValueError, TypeError) as error:
            raise LogError(f"the attachment config.json makes no sense: {error}") from error

    def wants(self, topic: str) -> bool:
        """Tell whether to keep the messages of a topic."""
        return topic in (self._topics or (topic,))

    def take(self, data: memoryview, record: FileRecord) -> int:
        """Take a record of `data` and the similar records after it; return where they end.

        Chunks are not unpacked here: pass their records to `inside`.
        """
        match record.opcode:
            case Opcode.MESSAGE:
                return self._message(data, record)
            case Opcode.SCHEMA:
                schema = Schema.read(record.stream())
                self.schemas.setdefault(schema.id, schema)
            case Opcode.CHANNEL:
                self._channel(Channel.read(record.stream()))
            case Opcode.ATTACHMENT:
                attachment = Attachment.read(record.stream())
                self.attachments[attachment.name] = attachment.data
            case Opcode.METADATA:
                metadata = Metadata.read(record.stream())
                self.metadata[metadata.name] = clean_document(metadata.metadata)
        return record.end

    def inside(self, chunk: memoryview, chunk_at: int = -1) -> None:
        """Take the records of a chunk, which begins at this place of the file."""
        self.chunk_at, at = chunk_at, 0
        while at < len(chunk):
            at = self.take(chunk, record_at(chunk, at))
        self.chunk_at = -1

    def _channel(self, channel: Channel) -> None:
        self.channels.setdefault(channel.id, channel)
        if channel.topic != TICK_TOPIC or channel.id == self.tick_channel:
            return
        if self.ticks is not None or channel.message_encoding != "protobuf":
            raise UnknownLayout(f"{TICK_TOPIC} is not one channel of protobuf messages")
        self.ticks = TickDecoder(self.schemas[channel.schema_id], self._take_ticks, self._fields)
        self.tick_channel = channel.id

    def _message(self, data: memoryview, record: FileRecord) -> int:
        channel = self.channels[int.from_bytes(record.body[:2], "little")]
        if self.ticks is not None and channel.id == self.tick_channel:
            ticks, end = self.ticks.run(data, record)
            self.counts[channel.topic] += ticks
            return end
        self.counts[channel.topic] += 1
        if channel.topic in self.values and self.wants(channel.topic):
            message = Message.read(record.stream(), len(record.body))
            self.values[channel.topic].append(clean_document(from_json(message.data)))
        return record.end
