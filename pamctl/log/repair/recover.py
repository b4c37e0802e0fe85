"""Repair a damaged log: copy its undamaged parts into a new file."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from numpy.typing import NDArray

from pamctl.json_text import from_json
from pamctl.kept_memory import keep_freed_memory
from pamctl.log.container import PackedChunk
from pamctl.log.framing import (
    NO_CHECKSUM,
    Damage,
    FileRecord,
    LogError,
    map_log_file,
    read_chunk_content,
    record_at,
    records_in,
    translate_parse_errors,
    verify_checksum,
)
from pamctl.log.repair.salvage import Hole, is_data_verified, read_summary, salvage_records
from pamctl.log.schema import JSON_SCHEMAS, TICK_TOPIC
from pamctl.log.ticks import find_message_run
from pamctl.log.writer import NO_SCHEMA, LogWriter
from pamctl.new_file import create_new_file
from pamctl.plain_text import escape_name


@dataclass(frozen=True)
class Recovery:
    """What was saved, and what was lost."""

    source: str
    destination: str
    messages: dict[str, int]
    """Number of saved messages, by topic."""
    damage: tuple[str, ...]
    """The damage of the source, one clause each."""
    lossless: bool
    """Whether everything that was logged is saved."""
    bytes_lost: int
    """Bytes of the source that could not be used."""
    unverified: tuple[str, ...] = ()
    """Names of saved metadata that no valid checksum covers; they have none of their own."""


def recover_file(source: str | Path, destination: str | Path) -> Recovery:
    """Save the undamaged parts of a log into a new file; raise LogError if there are none.

    Raise NewFileError if the file cannot be written.

    Works on any MCAP file. A damaged chunk is left out. If lengths are damaged, the next chunk is
    found by its checksum. The source is not changed.
    """
    source, destination = Path(source), Path(destination)
    file = map_log_file(source)
    keep_freed_memory()
    with create_new_file(destination) as stream:
        writer = LogWriter(stream)
        copy = LogCopy(writer)
        copy.file(file)
        if not copy.saved:
            raise LogError(f"nothing of {source} can be saved: {'; '.join(copy.damage)}")
        recovery = Recovery(
            source=str(source),
            destination=str(destination),
            messages=dict(copy.saved),
            damage=tuple(copy.damage),
            lossless=copy.lossless,
            bytes_lost=copy.bytes_lost,
            unverified=copy.unverified,
        )
        sign_recovery(writer, recovery)
    return recovery


def sign_recovery(writer: LogWriter, recovery: Recovery) -> None:
    """Write into the log that it was repaired, and finish it."""
    writer.metadata(
        "recovery",
        {
            "source": escape_name(recovery.source),
            "damage": "; ".join(recovery.damage),
            "lossless": str(recovery.lossless).lower(),
            "unverified": ", ".join(recovery.unverified),
        },
    )
    writer.finish()


def _is_description(record: FileRecord) -> bool:
    return record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL)


class LogCopy:
    """Copies the undamaged parts of a log into another log."""

    def __init__(self, writer: LogWriter) -> None:
        self._writer = writer
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, tuple[str, int]] = {}
        self.saved: Counter[str] = Counter()
        self.damage: list[str] = []
        self.lost = False
        """Whether something within the file was damaged."""
        self.cut = True
        """Whether the end of the file is missing."""
        self.bytes_lost = 0
        self._verified = False
        """Whether a checksum of the whole file shows that its data are undamaged."""
        self._metadata: dict[str, None] = {}
        self._looked_ahead = False
        self.last_tick = -(1 << 62)
        self.last_row = -1

    def file(self, file: memoryview) -> None:
        """Copy the undamaged part of a file's data; the summary is computed again."""
        self._verified = is_data_verified(file)
        self._learn_channels(file)
        for part in salvage_records(file):
            if isinstance(part, Hole):
                self.damage.append(str(part.damage))
                self.bytes_lost += part.bytes_lost
                # A cut at the end loses nothing if the ring holds the rest.
                self.lost = self.lost or (self.cut and not part.at_end)
            else:
                if part.opcode == Opcode.CHUNK and not self._looked_ahead:
                    self._looked_ahead = True
                    self._learn_ahead(file, part)
                self._try_copy(file, part)
                self.cut = self.cut and part.opcode != Opcode.DATA_END

    @property
    def lossless(self) -> bool:
        """Whether everything that was in the file is saved."""
        return not (self.lost or self.cut)

    @property
    def unverified(self) -> tuple[str, ...]:
        """Names of copied metadata that no checksum covers."""
        return () if self._verified else tuple(self._metadata)

    def _learn_channels(self, file: memoryview) -> None:
        """Learn the channels from an undamaged summary, in case the first chunk is damaged."""
        for record in read_summary(file):
            if _is_description(record):
                with suppress(Damage), translate_parse_errors(record):
                    self._copy(file, record)

    def _learn_ahead(self, file: memoryview, first: FileRecord) -> None:
        """Learn the channels from the first chunk that describes them."""
        for part in salvage_records(file):
            if isinstance(part, Hole) or part.opcode != Opcode.CHUNK or part.start < first.start:
                continue
            with suppress(Damage), translate_parse_errors(part):
                for record in takewhile(
                    _is_description, records_in(memoryview(self._unpack_chunk(part).content))
                ):
                    self._copy(file, record)
            if self._channels:
                return

    def _unpack_chunk(self, record: FileRecord) -> PackedChunk:
        chunk = Chunk.read(record.stream())
        self._refuse_unchecked(record, chunk.uncompressed_crc != 0)
        return PackedChunk(
            read_chunk_content(chunk), chunk.compression, chunk.data, chunk.uncompressed_crc
        )

    def _try_copy(self, file: memoryview, record: FileRecord) -> None:
        try:
            with translate_parse_errors(record):
                if not (self._verified and record.opcode == Opcode.DATA_END):  # verified before
                    verify_checksum(file, record)
                if self.cut:  # the summary is computed again
                    self._copy(file[: record.end], record)
        except Damage as damage:
            self.damage.append(str(damage))
            self.lost = self.lost or self.cut
            if record.opcode != Opcode.DATA_END:
                self.bytes_lost += record.end - record.start

    def _copy(self, data: memoryview, record: FileRecord) -> int:
        """Copy a record of `data`, and the similar messages after it; return where they end."""
        match record.opcode:
            case Opcode.CHUNK:
                packed, at = self._unpack_chunk(record), 0
                inside = memoryview(packed.content)
                while at < len(inside):
                    at = self._copy(inside, record_at(inside, at))
                self._writer.end_chunk(packed)
            case Opcode.MESSAGE:
                return self._copy_messages(data, record)
            case Opcode.SCHEMA:
                schema = Schema.read(record.stream())
                self._schemas[schema.id] = schema
            case Opcode.CHANNEL:
                self._copy_channel(Channel.read(record.stream()))
            case Opcode.ATTACHMENT:
                a = Attachment.read(record.stream())
                self._refuse_unchecked(record, record.body[-4:] != NO_CHECKSUM)
                self._writer.attachment(a.name, a.data, a.log_time, a.media_type)
            case Opcode.METADATA:
                metadata = Metadata.read(record.stream())
                self._writer.metadata(metadata.name, metadata.metadata)
                self._metadata[metadata.name] = None
        return record.end

    def _refuse_unchecked(self, record: FileRecord, checked: bool) -> None:
        """Raise Damage for parts without a checksum: a block of zeros would look like that."""
        if not (checked or self._verified):
            raise Damage(record.start, "it has no checksum: damage would not be noticed")

    def _copy_channel(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        known = (schema.name, schema.encoding, schema.data) if schema else NO_SCHEMA
        copied = self._writer.channel(
            channel.topic, channel.message_encoding, known, channel.metadata
        )
        self._channels[channel.id] = (channel.topic, copied)

    def select_messages(self, topic: str, messages: NDArray[Any]) -> NDArray[Any]:
        """Return those of these messages that are to be copied: all, unless a subclass differs."""
        del topic
        return messages

    def _copy_messages(self, data: memoryview, first: FileRecord) -> int:
        run = find_message_run(data, first)
        end = first.start + run.nbytes
        channel = int(run["channel"][0])
        if channel not in self._channels:
            raise Damage(first.start, f"channel {channel} was described in a lost part")
        topic, copied = self._channels[channel]
        run = self.select_messages(topic, run)
        if not len(run):
            return end
        if topic in JSON_SCHEMAS:
            rows = (from_json(bytes(body)).get("row", -1) for body in run["body"])
            self.last_row = max(self.last_row, *rows)
        elif topic == TICK_TOPIC:
            self.last_tick = max(self.last_tick, int(run["sequence"].max()))
        self._writer.add(copied, run.copy())
        self.saved[topic] += len(run)
        return end
