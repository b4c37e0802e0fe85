"""Write a log as an MCAP file: its description, chunks of messages, their index, the summary.

The writer of the `mcap` package takes messages one by one, which is most of the cost of logging a
tick. It also describes a channel in the first chunk only: if that chunk and the summary are lost,
the whole file is unreadable. Here ticks are added by the hundred, and descriptions are repeated.
A chunk of another log is taken over as it is packed. https://mcap.dev/spec

Measured with 100 000 ticks in chunks of 250: the package's writer needs 3.6 times the processor
time.
"""

from __future__ import annotations

import ctypes
import platform
import sys
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from io import BufferedRandom, BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap import records as mcap
from mcap.opcode import Opcode
from numpy.typing import NDArray

import pamctl
from pamctl.base.texts import to_json
from pamctl.log.file_index import DESCRIPTIONS, FileIndex
from pamctl.log.framing import FRAME, MAGIC, NO_CHECKSUM, FileRecord, encode_record, record_at
from pamctl.log.record_walk import Loaded, MessageRun, Part, walk_messages
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import (
    JSON_SCHEMAS,
    SCHEMA_VERSION,
    TICK_MESSAGE,
    TICK_TOPIC,
    tick_descriptor,
    units_of_columns,
)

LIBRARY = f"pamctl/{pamctl.__version__}"
NO_SCHEMA = ("", "", b"")
DESCRIBED_EVERY = 16
"""Every 16th chunk repeats all schemas and channels; so does the second chunk."""

_LEVEL = 1
"""Of zstd: half the time of its default, for files that are 4 % larger."""
_MEDIA_TYPES = {".json": "application/json", ".yaml": "application/yaml"}


class LogWriter:
    """A log under construction. The caller opens, syncs and closes its stream."""

    def __init__(self, stream: BufferedWriter | BufferedRandom, *, begins: bool = True) -> None:
        """Write the file's header, unless the stream has it: `resume_log` reads what is there."""
        self._stream = stream
        self._at = self._crc = 0
        self.index = FileIndex()
        """What is in the file."""
        self._attached: set[str] = set()
        self._said: set[tuple[str, bytes]] = set()
        """Metadata by name and content."""
        self._inside = bytearray()
        """What will be compressed as the next chunk."""
        self._has_messages = False
        self._described_inside: set[int] = set()
        self._described: set[int] = set()
        """Channels that a reader of the file so far knows."""
        self._compressor = zstandard.ZstdCompressor(_LEVEL)
        self._unindexed: dict[int, NDArray[Any]] = {}
        """Entries of the last chunk that was taken over, whose index is not in the file yet."""
        if begins:
            self._put(MAGIC)
            self._put(encode_record(mcap.Header("", LIBRARY)))

    @property
    def pending_bytes(self) -> int:
        """Bytes that were added since the last chunk."""
        return len(self._inside)

    def channel(
        self,
        topic: str,
        encoding: str,
        schema: tuple[str, str, bytes],
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Return the number of a channel; register it at first use.

        `schema` is name, encoding and data, all empty for no schema.
        """
        known = {(one.name, one.encoding, one.data): i for i, one in self.index.schemas.items()}
        schema_id = 0 if schema == NO_SCHEMA else known.get(schema)
        if schema_id is None:
            schema_id = max(self.index.schemas, default=0) + 1
            name, kind, data = schema
            self.index.take(make_record(mcap.Schema(schema_id, data, kind, name)))
        for number, channel in self.index.channels.items():
            if (channel.topic, channel.schema_id) == (topic, schema_id):
                return number
        number = max(self.index.channels, default=0) + 1
        made = mcap.Channel(number, topic, encoding, dict(metadata or {}), schema_id)
        self.index.take(make_record(made))
        self._describe(number)
        return number

    def attachment(self, name: str, data: bytes, time_ns: int = 0, media_type: str = "") -> None:
        """Attach a file, unless one of this name is attached; the suffix gives the media type."""
        if name not in self._attached:
            self._attached.add(name)
            known = media_type or _MEDIA_TYPES.get(Path(name).suffix, "text/plain")
            self._put_indexed(mcap.Attachment(time_ns, time_ns, name, known, data))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record, unless the same record was added before."""
        said = (name, to_json(values))
        if said not in self._said:
            self._said.add(said)
            self._put_indexed(mcap.Metadata(name=name, metadata=dict(values)))

    def has_metadata(self, name: str) -> bool:
        """Tell whether there is a metadata record of this name."""
        return any(name == known for known, _ in self._said)

    def add(self, channel: int, records: NDArray[Any]) -> None:
        """Add message records of equal length to this channel; their own channel is overwritten."""
        if len(records):
            records["channel"] = channel
            if channel not in self._described:
                self._describe(channel)
            self._inside += records.view(np.uint8).data
            self._has_messages = True

    def _describe(self, channel: int) -> None:
        """Describe a channel in the next chunk, once."""
        if channel not in self._described_inside:
            self._described_inside.add(channel)
            schema, described = self.index.describe(channel)
            self._inside += b"" if schema in self._inside else schema
            self._inside += described

    def end_chunk(self) -> None:
        """Write everything added so far as a chunk, and hand it to the operating system.

        Only the caller ends chunks: if the writer did so by size, the caller would not know which
        messages are in the file.
        """
        if self._has_messages:
            content, self._inside = self._inside, bytearray()
            self._described_inside.clear()
            self._has_messages = False
            packed = self._compressor.compress(content)
            chunk = mcap.Chunk("zstd", packed, 0, 0, zlib.crc32(content), len(content))
            self._put_chunk(chunk, list(walk_messages(memoryview(content))))
            if self.index.chunks == 1 or self.index.chunks % DESCRIBED_EVERY == 0:
                for channel in self.index.channels:
                    self._describe(channel)
        self._stream.flush()

    def copy_chunk(self, chunk: mcap.Chunk, parts: Iterable[Part]) -> None:
        """Write a whole chunk of another file as it is packed, `parts` being what it holds.

        Its channels keep their numbers: they must be the writer's. The head of a chunk has no
        checksum: it is computed again.
        """
        if self._has_messages:
            self.end_chunk()
        self._inside.clear()
        self._described_inside.clear()
        # Nothing else belongs into a chunk, and the index does not list it.
        known = [p for p in parts if isinstance(p, MessageRun) or p.opcode in DESCRIPTIONS]
        inside = _find_described(known)
        for part in known:
            if isinstance(part, FileRecord):
                self.index.take(part)
            elif part.channel not in inside:
                self._put_description(part.channel)
        if not chunk.compression:
            chunk.uncompressed_size = len(chunk.data)
        self._put_chunk(chunk, known)
        self._stream.flush()

    def take_over(self, loaded: Loaded) -> None:
        """Take note of a sound record that the stream has already; call it for each, in order."""
        record, length = loaded.record, loaded.record.end - loaded.record.start
        if record.opcode == Opcode.MESSAGE_INDEX:
            channel = int.from_bytes(record.body[:2], "little")
            if self._unindexed.pop(channel, None) is not None:
                self.index.add_message_index(channel, record.start, length)
                self._at = record.end
            return
        _, entries = self.index.take_parts(loaded.parts)
        self._described |= _find_described(loaded.parts)
        self._at, self._unindexed = record.end, {}
        match record.opcode:
            case Opcode.CHUNK:
                assert loaded.chunk is not None
                self.index.add_chunk(loaded.chunk, record.start, length)
                self._unindexed = entries
            case Opcode.ATTACHMENT:
                self._attached.add(mcap.Attachment.read(record.stream()).name)
            case Opcode.METADATA:
                said = mcap.Metadata.read(record.stream())
                self._said.add((said.name, to_json(said.metadata)))

    def go_on(self, crc_of: Callable[[int], int]) -> int:
        """Go on writing behind the records taken over; return where they end.

        `crc_of` returns the checksum of so many first bytes of the stream. The stream is cut there
        before the next record is written.
        """
        self._crc = crc_of(self._at)
        self._stream.seek(self._at)
        self._stream.truncate()
        end = self._at
        self._put_message_indexes(self._unindexed)
        self._unindexed = {}
        for channel in self.index.channels:
            self._describe(channel)
        return end

    def _put_chunk(self, chunk: mcap.Chunk, parts: Sequence[Part]) -> None:
        """Write a chunk that holds these parts; its times are those of its messages."""
        (start, end), entries = self.index.take_parts(parts)
        chunk.message_start_time, chunk.message_end_time = start, end
        self.index.add_chunk(chunk, *self._put(encode_record(chunk)))
        self._put_message_indexes(entries)
        self._described |= _find_described(parts)

    def _put_message_indexes(self, entries: Mapping[int, NDArray[Any]]) -> None:
        for channel, found in entries.items():
            body = channel.to_bytes(2, "little") + found.nbytes.to_bytes(4, "little")
            frame = FRAME.pack(Opcode.MESSAGE_INDEX, len(body) + found.nbytes) + body
            self.index.add_message_index(channel, *self._put(frame + found.tobytes()))

    def finish(self) -> None:
        """Write the last chunk, the summary and the footer."""
        self.end_chunk()
        for channel in self.index.channels:  # those without messages
            self._put_description(channel)
        self._put(encode_record(mcap.DataEnd(self._crc)))
        self._put(self._encode_summary())
        self._stream.flush()

    def _encode_summary(self) -> bytes:
        """Return all that follows the data: the summary, the footer, the magic bytes."""
        start, summary, offsets = self._at, b"", b""
        for opcode, group in self.index.groups().items():
            if records := b"".join(group):
                offsets += encode_record(
                    mcap.SummaryOffset(opcode, start + len(summary), len(records))
                )
                summary += records
        footer = mcap.Footer(start, start + len(summary) if offsets else 0, 0)
        summary += offsets
        footer.summary_crc = zlib.crc32(summary + encode_record(footer)[: -len(NO_CHECKSUM)])
        return summary + encode_record(footer) + MAGIC

    def _put_description(self, channel: int) -> None:
        """Describe a channel in no chunk, unless a reader of the file so far knows it."""
        if channel not in self._described:
            self._described.add(channel)
            self._put(b"".join(self.index.describe(channel)))

    def _put_indexed(self, record: mcap.McapRecord) -> None:
        made = make_record(record, self._at)
        self._put(made.frame())
        self.index.take(made)

    def _put(self, data: bytes) -> tuple[int, int]:
        """Write; return the offset and the length."""
        offset = self._at
        self._crc = zlib.crc32(data, self._crc)
        self._stream.write(data)
        self._at += len(data)
        return offset, len(data)


def _find_described(parts: Iterable[Part]) -> set[int]:
    """Return the numbers of the channels that are described in a chunk."""
    records = (part for part in parts if isinstance(part, FileRecord))
    return {int.from_bytes(r.body[:2], "little") for r in records if r.opcode == Opcode.CHANNEL}


def make_record(record: mcap.McapRecord, at: int = 0) -> FileRecord:
    """Return a record as it stands in a file, at this place."""
    found = record_at(memoryview(encode_record(record)), 0)
    return found._replace(start=at, end=at + found.end)


def begin_log(writer: LogWriter, meta: RunMeta) -> dict[str, int]:
    """Write the description of a run, as far as it is not there; return each topic's channel."""
    # Readers keep one record of each name: the run's own values belong into the same record.
    said = {"pamctl": {}, **meta.metadata}
    for name, values in said.items():
        if not writer.has_metadata(name):
            origin = _describe_origin(meta) if name == "pamctl" else {}
            writer.metadata(name, {**origin, **values})
    writer.attachment("config.json", to_json(meta.config), meta.start_wall_ns)
    for name, text in meta.attachments.items():
        writer.attachment(name, text.encode(), meta.start_wall_ns)
    tick_schema = (TICK_MESSAGE, "protobuf", tick_descriptor(meta.tick_fields))
    tick_metadata = {
        "schema_version": str(SCHEMA_VERSION),
        "units": to_json(units_of_columns(meta.tick_fields)).decode(),
        **({"origin": meta.origin} if meta.origin else {}),
    }
    return {
        TICK_TOPIC: writer.channel(TICK_TOPIC, "protobuf", tick_schema, tick_metadata),
        **{
            topic: writer.channel(topic, "json", (name, "jsonschema", schema))
            for topic, (name, schema) in JSON_SCHEMAS.items()
        },
    }


def _describe_origin(meta: RunMeta) -> dict[str, str]:
    return {
        "version": pamctl.__version__,
        "schema_version": str(SCHEMA_VERSION),
        "start": datetime.fromtimestamp(meta.start_wall_ns / 1e9, UTC).isoformat(),
        "host": platform.node(),
        "kernel": platform.release(),
        "machine": platform.machine(),
        "python": sys.version.split()[0],
        **{name: version(name) for name in ("mcap", "numpy", "protobuf")},
        **({"origin": meta.origin} if meta.origin else {}),
    }


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT_BYTES = 32 << 20


def keep_freed_memory() -> None:
    """Tell the C library to keep what is freed; do nothing where it is not glibc.

    Otherwise the kernel takes large blocks back at once and clears every page anew: two fifths of
    the time in which a chunk of a log is written or copied.
    """
    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
