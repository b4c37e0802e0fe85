"""What the end of a file says of its data, made by the writer.

https://mcap.dev/spec
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from mcap import records as mcap
from mcap.opcode import Opcode
from numpy.typing import NDArray

from pamctl.log.framing import FileRecord, encode_record
from pamctl.log.record_walk import Part

INDEX_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])

DESCRIPTIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
"""Records that stand in the data, in chunks and in the summary."""


class FileIndex:
    """What the end of a file says of its data: descriptions, counts, times and places."""

    def __init__(self) -> None:
        """Begin before the file's first record."""
        self.schemas: dict[int, mcap.Schema] = {}
        self.channels: dict[int, mcap.Channel] = {}
        self.frames: dict[int, dict[int, bytes]] = {kind: {} for kind in DESCRIPTIONS}
        """The records of these by kind and number, as they stand in the file."""
        self.counts: Counter[int] = Counter()
        """Messages by channel."""
        self.chunks = 0
        """Number of chunks."""
        self._chunk: mcap.ChunkIndex | None = None
        """The last chunk, whose message indexes may follow."""
        self._encoded: dict[Opcode, list[bytes]] = {
            kind: []
            for kind in (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
        }
        self._times: list[int] = []
        """Of the earliest and the latest message, ns."""

    def knows(self, channel: int) -> bool:
        """Tell whether a channel and its schema are described."""
        found = self.channels.get(channel)
        return found is not None and found.schema_id in {0, *self.schemas}

    def describe(self, channel: int) -> tuple[bytes, bytes]:
        """Return the records of a known channel's schema, if it has one, and of the channel."""
        schema = self.frames[Opcode.SCHEMA].get(self.channels[channel].schema_id, b"")
        return schema, self.frames[Opcode.CHANNEL][channel]

    def take(self, record: FileRecord) -> None:
        """Take a record that is neither a chunk nor a message."""
        length = record.end - record.start
        match record.opcode:
            case Opcode.SCHEMA:
                schema = mcap.Schema.read(record.stream())
                self.schemas.setdefault(schema.id, schema)
                self.frames[record.opcode].setdefault(schema.id, record.frame())
            case Opcode.CHANNEL:
                channel = mcap.Channel.read(record.stream())
                self.channels.setdefault(channel.id, channel)
                self.frames[record.opcode].setdefault(channel.id, record.frame())
            case Opcode.ATTACHMENT:
                a = mcap.Attachment.read(record.stream())
                place = (record.start, length, a.create_time, a.log_time, len(a.data))
                self._add(
                    Opcode.ATTACHMENT_INDEX, mcap.AttachmentIndex(*place, a.name, a.media_type)
                )
            case Opcode.METADATA:
                name = mcap.Metadata.read(record.stream()).name
                self._add(Opcode.METADATA_INDEX, mcap.MetadataIndex(record.start, length, name))

    def _add(self, kind: Opcode, entry: mcap.McapRecord) -> None:
        self._encoded[kind].append(encode_record(entry))

    def take_parts(self, parts: Iterable[Part]) -> tuple[tuple[int, int], dict[int, NDArray[Any]]]:
        """Take what follows in the data, not over the end of a chunk.

        Return its first and last time, and its message index by channel.
        """
        entries: dict[int, list[NDArray[Any]]] = {}
        ends: list[int] = []
        for part in parts:
            if isinstance(part, FileRecord):
                self.take(part)
                continue
            times = part.records["log_time"]
            ends += int(times.min()), int(times.max())
            self.counts[part.channel] += len(times)
            found = np.empty(len(times), INDEX_ENTRY)
            found["time"] = times
            found["offset"] = part.start + part.records.itemsize * np.arange(len(times))
            entries.setdefault(part.channel, []).append(found)
        if ends:
            self._times = [min([*self._times, *ends]), max([*self._times, *ends])]
        span = min(ends, default=0), max(ends, default=0)
        return span, {channel: np.concatenate(found) for channel, found in entries.items()}

    def add_chunk(self, chunk: mcap.Chunk, offset: int, length: int) -> None:
        """Note where a chunk stands; its message indexes follow with `add_message_index`."""
        self._end_chunk()
        self.chunks += 1
        self._chunk = mcap.ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )

    def _end_chunk(self) -> None:
        """Encode the index of the last chunk: an hour of them takes much memory otherwise."""
        if self._chunk:
            self._add(Opcode.CHUNK_INDEX, self._chunk)
            self._chunk = None

    def add_message_index(self, channel: int, offset: int, length: int) -> None:
        """Note where an index of the last chunk stands."""
        if self._chunk:
            self._chunk.message_index_offsets[channel] = offset
            self._chunk.message_index_length += length

    def groups(self) -> dict[Opcode, list[bytes]]:
        """Return the records of the summary by kind, encoded."""
        self._end_chunk()
        start, end = self._times or (0, 0)
        statistics = mcap.Statistics(
            attachment_count=len(self._encoded[Opcode.ATTACHMENT_INDEX]),
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=self.chunks,
            message_count=self.counts.total(),
            message_end_time=end,
            message_start_time=start,
            metadata_count=len(self._encoded[Opcode.METADATA_INDEX]),
            schema_count=len(self.schemas),
        )
        return {
            **{kind: list(self.frames[kind].values()) for kind in DESCRIPTIONS},
            Opcode.STATISTICS: [encode_record(statistics)],
            **self._encoded,
        }
