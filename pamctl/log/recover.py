"""Mend logs: save what is whole of a damaged file, finish what a dead recorder left.

A log that was cut short lacks its index, and the chunk that was being written.
That chunk's rows are still in the ring, unless the machine itself went down.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BufferedWriter
from itertools import count, takewhile
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema

from pamctl.log.container import Packed
from pamctl.log.newfile import new_file
from pamctl.log.records import (
    NO_CHECKSUM,
    Damage,
    LogError,
    Record,
    content_of,
    making_sense,
    mapped,
    record_at,
    records_in,
    verify,
)
from pamctl.log.salvage import Hole, data_vouched, salvage, summary_of
from pamctl.log.schema import JSON_SCHEMAS, TICK_TOPIC
from pamctl.log.text import from_json
from pamctl.log.ticks import run_of
from pamctl.log.writer import NO_SCHEMA, LogWriter

if TYPE_CHECKING:
    from pamctl.realtime.ring import Ring

_LOOP_DEAD_NS = 2_000_000_000


@dataclass(frozen=True)
class Recovery:
    """What was saved, and what was not."""

    source: str
    destination: str
    messages: dict[str, int]
    """Saved messages by topic."""
    damage: tuple[str, ...]
    """What was wrong with the source, one clause each."""
    lossless: bool
    """Whether all that was ever logged is saved."""
    bytes_lost: int
    """Bytes of the source that nothing could be made of."""
    unverified: tuple[str, ...] = ()
    """Names of saved metadata that no whole checksum vouches for: they have none of their own."""


class Orphan(NamedTuple):
    """A ring that nobody held: its log was finished, or `problem` says why not."""

    ring: Path
    recovery: Recovery | None
    problem: str


def recover(source: str | Path, destination: str | Path) -> Recovery:
    """Save all that is whole of a log into a new file; raise LogError if nothing is.

    Works on any MCAP file. A damaged chunk is left out and the next one saved, which is
    found by its checksum where lengths lead nowhere. The source is not touched.
    """
    source, destination = Path(source), Path(destination)
    file = mapped(source)
    with new_file(destination) as stream:
        writer = LogWriter(stream)
        copy = _Copy(writer)
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
        _sign(writer, recovery)
    return recovery


def finish_from_ring(ring_path: str | Path) -> Recovery:
    """Finish the log of a recorder that died, in its place; then remove the ring.

    The recorder must be dead, and the loop must have put its last row. Raise
    RingError if there is no such ring, LogError or OSError if the log cannot be
    written: then the ring stays, and so does the part of the log that there is.
    """
    from pamctl.realtime.ring import Ring

    with Ring.attach(ring_path) as ring:
        ring.hold()  # the next start must not take it for an orphan's
        recovery = _finish(ring)
        ring.unlink()
    return recovery


def recover_orphans(directory: str | Path = "/dev/shm") -> list[Orphan]:
    """Finish the logs of runs that died with all their processes; remove their rings.

    Never raises for a ring that cannot be dealt with: its `Orphan` says why.
    """
    from pamctl.realtime.ring import Ring

    found: list[Orphan] = []
    for path in sorted(Path(directory).glob("pamctl-*.ring")):
        try:
            if not _is_my_file(path):
                continue
            with Ring.attach(path) as ring:
                if ring.claim() and monotonic_ns() - ring.loop_beat_ns > _LOOP_DEAD_NS:
                    _require_home(ring)
                    found.append(Orphan(path, _finish(ring), ""))
                    ring.unlink()
        # One bad ring must not keep a rig from starting, nor another log from being saved.
        except Exception as error:
            if path.exists():  # a run that ended meanwhile took its ring along
                found.append(Orphan(path, None, str(error)))
    return found


def _is_my_file(path: Path) -> bool:
    """Another user's ring is that user's to recover: it says which file to write.

    Root, who may open it, must not be told by anyone which of its files to replace.
    """
    return not path.is_symlink() and path.stat().st_uid == os.geteuid()


def _require_home(ring: Ring) -> None:
    folder = Path(ring.meta.log_path).parent
    if not folder.is_dir():
        told = f"{folder} is gone; make it again for the next start to finish the log in"
        raise LogError(f"{told}, or give the log up: rm {ring.path}")


def _finish(ring: Ring) -> Recovery:
    from pamctl.log.rows import RowLogger
    from pamctl.realtime.ring import RecorderFlag

    target = Path(ring.meta.log_path)
    if ring.recorder_flags & RecorderFlag.FINISHED:
        return Recovery(str(target), str(target), {}, (), lossless=True, bytes_lost=0)
    has_part = _is_ours(target, ring)
    if has_part:
        # One who was here before may have put it there: the draft's inode is about to replace
        # that one's in the ring, and until the draft stands in its place this file is still ours.
        ring.log_inode = target.stat().st_ino
    else:
        target = _unused(target)
    with _replacing(target, ring) as stream:
        writer = LogWriter(stream)
        rows = RowLogger(writer, ring.meta)
        copy = _Copy(writer)
        if has_part and target.stat().st_size:
            copy.file(mapped(target))
        rows.last_tick, rows.last_row = copy.last_tick, copy.last_row
        rest = ring.drain(ring.rows)
        rows.write(rest)
        recovery = Recovery(
            source=f"{target if has_part else 'no file'} and {ring.path}",
            destination=str(target),
            messages=dict(copy.saved + rows.written),
            damage=tuple(copy.damage),
            # Where the file was cut the ring goes on.
            lossless=not copy.lost,
            bytes_lost=copy.bytes_lost,
            unverified=copy.unverified,
        )
        _sign(writer, recovery)
    ring.commit(rest.end_row)
    ring.raise_flag(RecorderFlag.FINISHED)
    return recovery


def _is_ours(path: Path, ring: Ring) -> bool:
    """Tell whether the file is the one that the ring's recorder created."""
    return path.exists() and path.stat().st_ino in (ring.log_inode, ring.mended_inode)


def _unused(path: Path) -> Path:
    names = (path.with_stem(f"{path.stem}{suffix}") for suffix in _suffixes())
    return next(name for name in names if not name.exists())


def _suffixes() -> Iterator[str]:
    yield ""
    yield "-recovered"
    yield from (f"-recovered-{number}" for number in count(2))


def _sign(writer: LogWriter, recovery: Recovery) -> None:
    """Say in the log itself that it was mended, and end it."""
    writer.metadata(
        "recovery",
        {
            "source": recovery.source,
            "damage": "; ".join(recovery.damage),
            "lossless": str(recovery.lossless).lower(),
            "unverified": ", ".join(recovery.unverified),
        },
    )
    writer.finish()


@contextmanager
def _replacing(target: Path, ring: Ring) -> Iterator[BufferedWriter]:
    """Open a file beside the target that takes its place when the block ends well."""
    draft = target.with_name(f"{target.name}.recovering")
    draft.unlink(missing_ok=True)
    with new_file(draft) as stream:
        yield stream
        ring.mended_inode = os.fstat(stream.fileno()).st_ino
    draft.replace(target)
    directory = os.open(target.parent, os.O_RDONLY)
    os.fsync(directory)
    os.close(directory)


def _is_description(record: Record) -> bool:
    return record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL)


class _Copy:
    """Copies what is whole of one log into another."""

    def __init__(self, writer: LogWriter) -> None:
        self._writer = writer
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, tuple[str, int]] = {}
        self.saved: Counter[str] = Counter()
        self.damage: list[str] = []
        self.lost = False
        """Something within the file was damaged."""
        self.cut = True
        """The file has no end."""
        self.bytes_lost = 0
        self._vouched = False
        """Whether a checksum of the whole file says that there is no damage in the data."""
        self._metadata: dict[str, None] = {}
        self._looked_ahead = False
        self.last_tick = -(1 << 62)
        self.last_row = -1

    def file(self, file: memoryview) -> None:
        """Copy a file's data section as far as it is whole; the summary is made anew."""
        self._vouched = data_vouched(file)
        self._learn_channels(file)
        for part in salvage(file):
            if isinstance(part, Hole):
                self.damage.append(str(part.damage))
                self.bytes_lost += part.bytes_lost
                # Where the file was cut something else may go on: the ring.
                self.lost = self.lost or (self.cut and not part.at_end)
            else:
                if part.opcode == Opcode.CHUNK and not self._looked_ahead:
                    self._looked_ahead = True
                    self._learn_ahead(file, part)
                self._try(file, part)
                self.cut = self.cut and part.opcode != Opcode.DATA_END

    @property
    def lossless(self) -> bool:
        """Whether all that was ever in the file is saved."""
        return not (self.lost or self.cut)

    @property
    def unverified(self) -> tuple[str, ...]:
        """Names of metadata that were copied without any checksum's word for them."""
        return () if self._vouched else tuple(self._metadata)

    def _learn_channels(self, file: memoryview) -> None:
        """Learn from a whole summary what a damaged first chunk would not tell."""
        for record in summary_of(file):
            if _is_description(record):
                self._copy(file, record)

    def _learn_ahead(self, file: memoryview, first: Record) -> None:
        """Learn from the first chunk, or from the next one that tells it, which channels are."""
        for part in salvage(file):
            if isinstance(part, Hole) or part.opcode != Opcode.CHUNK or part.start < first.start:
                continue
            with suppress(Damage), making_sense(part):
                for record in takewhile(
                    _is_description, records_in(memoryview(self._unpacked(part).content))
                ):
                    self._copy(file, record)
            if self._channels:
                return

    def _unpacked(self, record: Record) -> Packed:
        chunk = Chunk.read(record.stream())
        self._refuse_unchecked(record, chunk.uncompressed_crc != 0)
        return Packed(content_of(chunk), chunk.compression, chunk.data, chunk.uncompressed_crc)

    def _try(self, file: memoryview, record: Record) -> None:
        try:
            with making_sense(record):
                if not (self._vouched and record.opcode == Opcode.DATA_END):  # done once
                    verify(file, record)
                if self.cut:  # what stands behind the data is made anew
                    self._copy(file[: record.end], record)
        except Damage as damage:
            self.damage.append(str(damage))
            self.lost = self.lost or self.cut
            if record.opcode != Opcode.DATA_END:
                self.bytes_lost += record.end - record.start

    def _copy(self, data: memoryview, record: Record) -> int:
        """Copy a record within `data`, a message with those alike behind it; return their end."""
        match record.opcode:
            case Opcode.CHUNK:
                packed, at = self._unpacked(record), 0
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

    def _refuse_unchecked(self, record: Record, checked: bool) -> None:
        """Raise Damage for what has no checksum: where a block was zeroed, it looks like that."""
        if not (checked or self._vouched):
            raise Damage(record.start, "nothing says whether it is whole: it has no checksum")

    def _copy_channel(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        known = (schema.name, schema.encoding, schema.data) if schema else NO_SCHEMA
        copied = self._writer.channel(
            channel.topic, channel.message_encoding, known, channel.metadata
        )
        self._channels[channel.id] = (channel.topic, copied)

    def _copy_messages(self, data: memoryview, first: Record) -> int:
        run = run_of(data, first)
        channel = int(run["channel"][0])
        if channel not in self._channels:
            raise Damage(first.start, f"channel {channel} was described in a part that is lost")
        topic, copied = self._channels[channel]
        if topic in JSON_SCHEMAS:
            rows = (from_json(bytes(body)).get("row", -1) for body in run["body"])
            self.last_row = max(self.last_row, *rows)
        elif topic == TICK_TOPIC:
            self.last_tick = max(self.last_tick, int(run["sequence"].max()))
        self._writer.add(copied, run.copy())
        self.saved[topic] += len(run)
        return first.start + run.nbytes
