"""A log of a few kilobytes, a way to change its bytes, and a look at the index of any log."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Statistics,
)
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from pamctl.base.new_file import create_new_file
from pamctl.base.texts import to_json
from pamctl.log.framing import FRAME, FileRecord, map_log_file, record_at, records_in
from pamctl.log.record_walk import walk_records
from pamctl.log.schema import (
    EVENT_TOPIC,
    IMPORTED,
    TICK_MESSAGE,
    TICK_TOPIC,
    imported_fields,
    tick_descriptor,
    units_of_columns,
)
from pamctl.log.wire import TickLayout, make_message_record, make_message_records
from pamctl.log.writer import NO_SCHEMA, LogWriter

CHUNKS = 2
CHUNK_TICKS = 6


def write_small(path: Path, chunks: int = CHUNKS, remark: str = "") -> Path:
    """Write chunks of six ticks and an event each, metadata and an attachment."""
    more = {"text": remark} if remark else {}
    fields = imported_fields(("position_m",))
    layout = TickLayout.of_fields(fields)
    tick = np.arange(chunks * CHUNK_TICKS)
    table = np.zeros(len(tick), layout.dtype)
    table["tick"], table["t_s"], table["dt_s"] = tick, tick * 1e-3, 1e-3
    table["position_m"] = np.sin(tick)
    messages = layout.encode(table)
    with create_new_file(path) as stream:
        writer = LogWriter(stream)
        writer.metadata("run", {"law": "qsmc", **more})
        writer.attachment("config.json", to_json({"law": "qsmc"}))
        schema = (TICK_MESSAGE, "protobuf", tick_descriptor(fields))
        known = {"schema_version": "1", "units": to_json(units_of_columns(fields)).decode()}
        ticks = writer.channel(TICK_TOPIC, "protobuf", schema, {**known, "origin": IMPORTED})
        events = writer.channel(EVENT_TOPIC, "json", NO_SCHEMA)
        for first in range(0, len(tick), CHUNK_TICKS):
            part = messages[first : first + CHUNK_TICKS]
            times_ns = part["tick"].astype(np.int64) * 1_000_000
            writer.add(ticks, make_message_records(part, times_ns, part["tick"]))
            data = to_json({"event": "x", "value": 0.1 * first, "row": first, **more})
            writer.add(events, make_message_record(data, int(times_ns[-1]), first))
            writer.end_chunk()
        writer.finish()
    return path


def rewritten(path: Path, edit: Callable[[FileRecord], bytes]) -> bytes:
    """Return a file whose records have other bodies of the same length, every checksum right."""
    file = map_log_file(path)
    out = bytearray(MCAP0_MAGIC)
    summary_at = 0
    for record in walk_records(file):
        body = bytearray(edit(record))
        if record.opcode == Opcode.DATA_END:
            body[:4] = struct.pack("<I", zlib.crc32(out))
            summary_at = len(out) + FRAME.size + len(body)
        elif record.opcode == Opcode.FOOTER:
            head = FRAME.pack(record.opcode, len(body)) + bytes(body[:16])
            body[16:] = struct.pack("<I", zlib.crc32(out[summary_at:] + head))
        out += FRAME.pack(record.opcode, len(body)) + body
    return bytes(out + MCAP0_MAGIC)


def require_right_index(path: Path) -> None:
    """Compare the index at the end of a log with its data, by the parsers of the mcap package."""
    file = map_log_file(path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    counts, times = Counter[int](), []
    for known in summary.chunk_indexes:
        place = record_at(file, known.chunk_start_offset)
        chunk = Chunk.read(place.stream())
        content, size = get_chunk_data_stream(chunk, validate_crc=True)
        data = memoryview(content.read(size))
        messages = [r for r in records_in(data) if r.opcode == Opcode.MESSAGE]
        found = [Message.read(r.stream(), len(r.body)) for r in messages]
        parts = {one.channel_id: [] for one in found}
        for record, one in zip(messages, found, strict=True):
            parts[one.channel_id].append((one.log_time, record.start))
        offsets = known.message_index_offsets
        indexes = {channel: record_at(file, at) for channel, at in offsets.items()}
        for channel, record in indexes.items():
            assert MessageIndex.read(record.stream()) == MessageIndex(channel, parts.pop(channel))
        assert not parts
        times += [one.log_time for one in found]
        span = times[-len(found) :]
        assert known == replace(
            known,
            chunk_length=place.end - place.start,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_index_length=sum(r.end - r.start for r in indexes.values()),
            message_start_time=min(span),
            message_end_time=max(span),
            uncompressed_size=size,
        )
        counts.update(one.channel_id for one in found)
    for said in summary.attachment_indexes:
        place = record_at(file, said.offset)
        a = Attachment.read(place.stream())
        what = (a.create_time, a.log_time, len(a.data), a.name, a.media_type)
        assert said == AttachmentIndex(said.offset, place.end - place.start, *what)
    for named in summary.metadata_indexes:
        place = record_at(file, named.offset)
        name = Metadata.read(place.stream()).name
        assert named == MetadataIndex(named.offset, place.end - place.start, name)
    assert summary.statistics == Statistics(
        attachment_count=len(summary.attachment_indexes),
        channel_count=len(summary.channels),
        channel_message_counts=dict(counts),
        chunk_count=len(summary.chunk_indexes),
        message_count=len(times),
        message_end_time=max(times),
        message_start_time=min(times),
        metadata_count=len(summary.metadata_indexes),
        schema_count=len(summary.schemas),
    )
