"""Check that a file conforms to the MCAP specification: order, references, indexes.

Checksums are verified where records are read (`pamctl.log.framing`). Here the expected index is
built from the records, and compared with the index in the file. `summary_check.py` compares the
summary. https://mcap.dev/spec
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from pamctl.log.check.log_problems import LogFindings
from pamctl.log.check.summary_check import SummaryCheck
from pamctl.log.container import index_attachment, index_chunk
from pamctl.log.framing import NO_CHECKSUM, Damage, FileRecord, record_at
from pamctl.log.ticks import INDEX_ENTRY, find_message_run

_IN_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_INDEX_ENTRY = np.dtype(INDEX_ENTRY)


class Conformance:
    """Follows the records of a file, and reports at the end what does not agree."""

    def __init__(self, findings: LogFindings) -> None:
        self._findings = findings
        self._last = 0
        self._in_summary = False
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._counts: Counter[int] = Counter()
        self._times: list[int] = []
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._expected_index: dict[int, NDArray[Any]] = {}
        self._summary = SummaryCheck(findings)

    def take(self, file: memoryview, record: FileRecord, chunk: memoryview | None) -> None:
        """Take the next record of the file; `chunk` holds the records of a chunk."""
        if self._last == 0 and record.opcode != Opcode.HEADER:
            self._add_error(
                "order", f"the file begins with a record {record.opcode} instead of its header"
            )
        if self._in_summary:
            self._summary.take(record)
        elif record.opcode == Opcode.CHUNK and chunk is not None:
            self._chunk(record, chunk)
        elif record.opcode == Opcode.MESSAGE_INDEX:
            self._check_message_index(record)
        elif record.opcode == Opcode.MESSAGE:
            self._take_messages(file, record, record.start, record.end)
        else:
            self._take_datum(record)
        self._last = record.opcode

    def lost(self, record: FileRecord) -> None:
        """Take a damaged record: its content is unknown, and is not reported as missing."""
        self._last = record.opcode
        self._in_summary = self._in_summary or record.opcode == Opcode.DATA_END

    def _take_datum(self, record: FileRecord) -> None:
        length = record.end - record.start
        match record.opcode:
            case Opcode.SCHEMA:
                self._take_schema(record)
            case Opcode.CHANNEL:
                self._channel(record)
            case Opcode.ATTACHMENT:
                a = Attachment.read(record.stream())
                if record.body[-4:] == NO_CHECKSUM:
                    self._warn_unchecked(f"the attachment {a.name}")
                self._attachments.append(index_attachment(a, record.start, length))
            case Opcode.METADATA:
                name = Metadata.read(record.stream()).name
                self._metadata.append(MetadataIndex(record.start, length, name))
            case Opcode.DATA_END:
                self._in_summary = True
                if DataEnd.read(record.stream()).data_section_crc == 0:
                    self._warn_unchecked("the data section")
            case Opcode.HEADER if self._last == 0:
                pass
            case _:
                self._add_error(
                    "order", f"at byte {record.start}, a record {record.opcode} among the data"
                )

    def _take_schema(self, record: FileRecord) -> None:
        number = int.from_bytes(record.body[:2], "little")
        if number == 0:
            self._add_error("schema", f"at byte {record.start}, a schema has the number 0")
        if self._schemas.setdefault(number, bytes(record.body)) != record.body:
            self._add_error("schema", f"schema {number} is described in two ways")
        Schema.read(record.stream())

    def _channel(self, record: FileRecord) -> None:
        channel = Channel.read(record.stream())
        if channel.schema_id and channel.schema_id not in self._schemas:
            self._add_error(
                "channel",
                f"channel {channel.topic} has schema {channel.schema_id}, which does not exist",
            )
        if self._channels.setdefault(channel.id, bytes(record.body)) != record.body:
            self._add_error("channel", f"channel {channel.id} is described in two ways")

    # --- chunks ---------------------------------------------------------------------------

    def _chunk(self, record: FileRecord, inside: memoryview) -> None:
        chunk, found = Chunk.read(record.stream()), []
        at = 0
        while at < len(inside):
            part = record_at(inside, at)
            if part.opcode not in _IN_CHUNKS:
                raise Damage(record.start, f"a chunk holds a record {part.opcode}")
            if part.opcode == Opcode.MESSAGE:
                found.append(self._take_messages(inside, part, part.start, len(inside)))
                at += found[-1][1]
            else:
                self._take_datum(part)
                at = part.end
        self._check_chunk(record, chunk, inside, found)

    def _take_messages(
        self, data: memoryview, first: FileRecord, start: int, end: int
    ) -> tuple[NDArray[Any], int]:
        """Take the messages of equal length from `first` on; return them and their bytes."""
        messages = find_message_run(data[:end], first)
        channel = int(messages["channel"][0])
        if channel not in self._channels:
            self._add_error(
                "channel",
                f"at byte {start}, messages of channel {channel}, which is not yet described",
            )
        self._counts[channel] += len(messages)
        self._times += [int(messages["log_time"].min()), int(messages["log_time"].max())]
        self._times = [min(self._times), max(self._times)]
        return messages, messages.nbytes

    def _check_chunk(
        self,
        record: FileRecord,
        chunk: Chunk,
        inside: memoryview,
        found: list[tuple[NDArray[Any], int]],
    ) -> None:
        where = f"the chunk at byte {record.start}"
        times = [messages["log_time"] for messages, _ in found]
        start, end = (min(map(np.min, times)), max(map(np.max, times))) if times else (0, 0)
        if (chunk.message_start_time, chunk.message_end_time) != (start, end):
            self._add_error("chunk", f"{where} states times that differ from those of its messages")
        if chunk.uncompressed_size != len(inside):
            self._add_error(
                "chunk",
                f"{where} states that it holds {chunk.uncompressed_size} bytes, not {len(inside)}",
            )
        if chunk.uncompressed_crc == 0:
            self._warn_unchecked(where)
        self._expected_index = _build_index(inside, found)
        self._chunks.append(index_chunk(chunk, record.start, record.end - record.start))

    def _check_message_index(self, record: FileRecord) -> None:
        channel = int.from_bytes(record.body[:2], "little")
        if self._last not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            self._add_error(
                "order", f"at byte {record.start}, a message index does not follow a chunk"
            )
        stored = np.frombuffer(record.body[6:], _INDEX_ENTRY)
        expected = self._expected_index.get(channel, stored[:0])
        size = int.from_bytes(record.body[2:6], "little")
        if size != stored.nbytes or not np.array_equal(np.sort(stored), np.sort(expected)):
            what = f"the message index of channel {channel} at byte {record.start}"
            self._add_error("index", f"{what} does not match its chunk")
        if self._chunks:
            index = self._chunks[-1]
            index.message_index_offsets[channel] = record.start
            index.message_index_length += record.end - record.start

    def end(self) -> None:
        """Compare the summary with the data. Call it only if the file is not damaged."""
        self._summary.compare(
            {
                Opcode.SCHEMA: sorted(self._schemas.values()),
                Opcode.CHANNEL: sorted(self._channels.values()),
                Opcode.CHUNK_INDEX: self._chunks,
                Opcode.ATTACHMENT_INDEX: self._attachments,
                Opcode.METADATA_INDEX: self._metadata,
                Opcode.STATISTICS: [self._statistics()],
            }
        )

    def _statistics(self) -> Statistics:
        start, end = self._times or (0, 0)
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=end,
            message_start_time=start,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _add_error(self, kind: str, message: str) -> None:
        self._findings.error(kind, message)

    def _warn_unchecked(self, what: str) -> None:
        self._findings.warning("checksum", f"{what} has no checksum: damage would not be noticed")


def _build_index(
    inside: memoryview, found: list[tuple[NDArray[Any], int]]
) -> dict[int, NDArray[Any]]:
    """Return the expected message index of a chunk, by channel."""
    base = np.frombuffer(inside, np.uint8).ctypes.data
    index: dict[int, list[NDArray[Any]]] = {}
    for messages, _ in found:
        entries = np.zeros(len(messages), _INDEX_ENTRY)
        entries["time"] = messages["log_time"]
        first = messages.ctypes.data - base
        entries["offset"] = first + messages.itemsize * np.arange(len(messages))
        index.setdefault(int(messages["channel"][0]), []).append(entries)
    return {channel: np.concatenate(parts) for channel, parts in index.items()}
