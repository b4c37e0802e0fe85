"""What a file says of its own data: made by the writer, and compared with the data by the check.

https://mcap.dev/spec
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from mcap import records as mcap
from mcap.opcode import Opcode
from numpy.typing import NDArray

from pamctl.log.framing import NO_CHECKSUM, Damage, FileRecord, encode_record, record_at
from pamctl.log.record_walk import Loaded, Part

INDEX_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])

DESCRIPTIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
"""Records that stand in the data, in chunks and in the summary."""

Complain = Callable[[str, str], None]
"""Gets a finding: its kind, and what is wrong."""


class FileIndex:
    """What the end of a file says of its data: descriptions, counts, times and places.

    The writer builds it from what it writes, the check from what it reads.
    """

    def __init__(self, complain: Complain = lambda kind, what: None) -> None:
        """`complain` is told of descriptions that are missing, or contradict each other."""
        self._complain = complain
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
                if schema.id == 0:
                    self._complain("schema", f"at byte {record.start}, a schema has the number 0")
                self.schemas.setdefault(schema.id, schema)
                self._keep_frame(record, "schema", schema.id)
            case Opcode.CHANNEL:
                channel = mcap.Channel.read(record.stream())
                if channel.schema_id not in {0, *self.schemas}:
                    there = f"schema {channel.schema_id}, which does not exist"
                    self._complain("channel", f"channel {channel.topic} has {there}")
                self.channels.setdefault(channel.id, channel)
                self._keep_frame(record, "channel", channel.id)
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

    def _keep_frame(self, record: FileRecord, what: str, number: int) -> None:
        frame = record.frame()
        if self.frames[record.opcode].setdefault(number, frame) != frame:
            self._complain(what, f"{what} {number} is described in two ways")

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
            if part.channel not in self.channels:
                where = f"messages of channel {part.channel}, which is not yet described"
                self._complain("channel", f"at byte {part.start}, {where}")
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


_SUMMARY: Mapping[int, Any] = {
    Opcode.SCHEMA: mcap.Schema,
    Opcode.CHANNEL: mcap.Channel,
    Opcode.SUMMARY_OFFSET: mcap.SummaryOffset,
    Opcode.CHUNK_INDEX: mcap.ChunkIndex,
    Opcode.ATTACHMENT_INDEX: mcap.AttachmentIndex,
    Opcode.METADATA_INDEX: mcap.MetadataIndex,
    Opcode.STATISTICS: mcap.Statistics,
    Opcode.FOOTER: mcap.Footer,
}


class IndexCheck:
    """Follows the records of a file, builds the index they should have, and compares it."""

    def __init__(self, error: Complain, warn: Complain) -> None:
        """Begin before the file's first record; get told of errors and warnings."""
        self._error, self._warn = error, warn
        self._index = FileIndex(error)
        self._expected: Mapping[int, NDArray[Any]] | None = {}
        """The message index of the last chunk, by channel; None where it is not known."""
        self._last = 0
        self._summary: list[FileRecord] = []
        """All that follows the data, the footer too."""
        self._in_summary = False

    def take(self, loaded: Loaded) -> None:
        """Take the next record."""
        record = loaded.record
        before, self._last = self._last, record.opcode
        if not before and record.opcode != Opcode.HEADER:
            begin = f"a record {record.opcode} instead of its header"
            self._error("order", f"the file begins with {begin}")
        if self._in_summary:
            self._take_of_summary(record)
            return
        match record.opcode:
            case Opcode.CHUNK:
                self._take_chunk(loaded)
            case Opcode.MESSAGE_INDEX:
                self._check_message_index(record, before)
            case Opcode.MESSAGE | Opcode.SCHEMA | Opcode.CHANNEL | Opcode.METADATA:
                self._index.take_parts(loaded.parts)
            case Opcode.ATTACHMENT:
                self._index.take_parts(loaded.parts)
                if record.body[-4:] == NO_CHECKSUM:
                    name = mcap.Attachment.read(record.stream()).name
                    self._warn_unchecked(f"the attachment {name}")
            case Opcode.DATA_END:
                self._in_summary = True
                if mcap.DataEnd.read(record.stream()).data_section_crc == 0:
                    self._warn_unchecked("the data section")
            case _ if before or record.opcode != Opcode.HEADER:
                where = f"at byte {record.start}, a record {record.opcode}"
                self._error("order", f"{where} among the data")

    def pass_over(self, opcode: int) -> None:
        """Take a damaged record: its content is unknown, and is not reported as missing."""
        self._last, self._expected = opcode or self._last, None
        self._in_summary = self._in_summary or opcode == Opcode.DATA_END

    def _take_chunk(self, loaded: Loaded) -> None:
        record, chunk = loaded.record, loaded.chunk
        assert chunk is not None
        for part in loaded.parts:
            if isinstance(part, FileRecord) and part.opcode not in DESCRIPTIONS:
                raise Damage(record.start, f"a chunk holds a record {part.opcode}")
        times, self._expected = self._index.take_parts(loaded.parts)
        where = f"the chunk at byte {record.start}"
        if (chunk.message_start_time, chunk.message_end_time) != times:
            what = "states times that differ from those of its messages"
            self._error("chunk", f"{where} {what}")
        size = len(loaded.content)
        if chunk.uncompressed_size != size:
            what = f"states that it holds {chunk.uncompressed_size} bytes, not {size}"
            self._error("chunk", f"{where} {what}")
        if chunk.uncompressed_crc == 0:
            self._warn_unchecked(where)
        self._index.add_chunk(chunk, record.start, record.end - record.start)

    def _check_message_index(self, record: FileRecord, before: int) -> None:
        channel = int.from_bytes(record.body[:2], "little")
        if before not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            where = f"at byte {record.start}, a message index"
            self._error("order", f"{where} does not follow a chunk")
        self._index.add_message_index(channel, record.start, record.end - record.start)
        if self._expected is None:
            return
        stored = np.frombuffer(record.body[6:], INDEX_ENTRY)
        expected = self._expected.get(channel, stored[:0])
        is_equal = record.body[6:] == expected.tobytes() or np.array_equal(
            np.sort(stored),
            np.sort(expected),  # slow: only where another program wrote it
        )
        if not is_equal or int.from_bytes(record.body[2:6], "little") != stored.nbytes:
            what = f"the message index of channel {channel} at byte {record.start}"
            self._error("index", f"{what} does not match its chunk")

    def _take_of_summary(self, record: FileRecord) -> None:
        if record.opcode in _SUMMARY:
            _parse_summary(record)  # raises where it makes no sense
            self._summary.append(record)
        else:
            where = f"at byte {record.start}, a record {record.opcode}"
            self._error("order", f"{where} after the data")

    def end(self) -> None:
        """Compare the summary with the data. Call it only if the file is not damaged."""
        *records, end = self._summary
        footer = _parse_summary(end)
        if footer.summary_start == 0:
            self._warn("index", "the file has no summary: viewers must scan the whole file")
            return
        if footer.summary_crc == 0:
            self._warn_unchecked("the summary")
        if footer.summary_start != self._summary[0].start:
            detail = f"the footer states a wrong start of the summary, {footer.summary_start}"
            self._error("summary", detail)
        groups: dict[int, list[FileRecord]] = {}
        for record in records:
            groups.setdefault(record.opcode, []).append(record)
        offsets = map(_parse_summary, groups.pop(Opcode.SUMMARY_OFFSET, []))
        stated = [offset for offset in offsets if offset.group_length]
        if stated and stated != [
            mcap.SummaryOffset(kind, group[0].start, sum(r.end - r.start for r in group))
            for kind, group in groups.items()
        ]:
            self._error("summary", "the summary offsets do not match the summary")
        for kind, expected in self._index.groups().items():
            what = kind.name.lower().replace("_", " ")
            if kind not in groups:
                if expected and groups:
                    self._warn("summary", f"the summary has no {what}")
            elif not _are_equal(kind, [record.frame() for record in groups[kind]], expected):
                self._error("summary", f"the {what} in the summary does not match the data")

    def _warn_unchecked(self, what: str) -> None:
        self._warn("checksum", f"{what} has no checksum: damage would not be noticed")


def _are_equal(kind: Opcode, stored: Sequence[bytes], expected: Sequence[bytes]) -> bool:
    """Tell whether records say the same; descriptions, and what a map holds, in any order."""
    if len(stored) != len(expected) or kind in DESCRIPTIONS:
        return sorted(stored) == sorted(expected)
    for one, other in zip(stored, expected, strict=True):
        found, right = (_parse_summary(record_at(memoryview(r), 0)) for r in (one, other))
        # The parsers are lenient: what they find is encoded again.
        if found != right or encode_record(found) != one:
            return False
    return True


def _parse_summary(record: FileRecord) -> Any:
    return _SUMMARY[record.opcode].read(record.stream())
