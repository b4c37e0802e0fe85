"""Repair a damaged log: take over every part that is whole, and finish the file.

A whole chunk is copied as it is packed; the index is made anew. `LogCopy` also makes a piece of a
log (`edit.py`). `resume_log` copies nothing: it goes on behind the last whole chunk of the file of
a dead recorder.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedRandom, BufferedWriter
from pathlib import Path
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata
from numpy.typing import NDArray

from pamctl.base.new_file import create_new_file
from pamctl.base.texts import escape_name
from pamctl.log.file_index import DESCRIPTIONS
from pamctl.log.framing import (
    MAGIC,
    NO_CHECKSUM,
    Damage,
    FileRecord,
    LogError,
    compute_checksum,
    is_data_verified,
    map_log_file,
    read_summary,
    translate_parse_errors,
)
from pamctl.log.record_walk import (
    Hole,
    Loaded,
    MessageRun,
    Part,
    load_records,
    parse_messages,
)
from pamctl.log.schema import JSON_SCHEMAS, TICK_TOPIC
from pamctl.log.writer import LogWriter, keep_freed_memory

_LOOSE_BYTES = 1 << 20


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
    copy = LogCopy(source)
    keep_freed_memory()
    with create_new_file(destination) as stream:
        writer = LogWriter(stream)
        copy.write(writer)
        if not copy.saved:
            raise LogError(f"nothing of {source} can be saved: {'; '.join(copy.damage)}")
        recovery = copy.describe(str(source), destination)
        sign_recovery(writer, recovery)
        writer.finish()
    return recovery


def sign_recovery(writer: LogWriter, recovery: Recovery) -> None:
    """Write into the log that it was repaired."""
    writer.metadata(
        "recovery",
        {
            "source": escape_name(recovery.source),
            "damage": "; ".join(recovery.damage),
            "lossless": str(recovery.lossless).lower(),
            "unverified": ", ".join(recovery.unverified),
        },
    )


NO_TICK, NO_ROW = -(1 << 62), -1
"""Before the first."""


class LogCopy:
    """Copies the undamaged parts of a log into another log, whose summary is computed again."""

    def __init__(self, path: Path | None) -> None:
        """Raise LogError if there is no such file. None: there is nothing to copy."""
        self._path = path or Path()
        self._file = map_log_file(path) if path else memoryview(b"")
        self.verified = is_data_verified(self._file)
        """Whether the data are known to be undamaged, by a checksum of the whole file."""
        self._metadata: dict[str, None] = {}
        self._has_looked_ahead = False
        self.saved: Counter[str] = Counter()
        """Messages by topic."""
        self.damage: list[str] = []
        self.lost = False
        """Whether something within the file was damaged."""
        self.cut = True
        """Whether the end of the file is missing."""
        self.bytes_lost = 0

    def describe(self, source: str, destination: Path) -> Recovery:
        """Return what was saved and lost so far."""
        return Recovery(
            source=source,
            destination=str(destination),
            messages=dict(self.saved),
            damage=tuple(self.damage),
            lossless=not (self.lost or self.cut),
            bytes_lost=self.bytes_lost,
            unverified=() if self.verified else tuple(self._metadata),
        )

    def write(self, writer: LogWriter) -> None:
        """Write what is undamaged; nothing else must have been written before."""
        if not len(self._file):
            return
        for record in read_summary(self._file):
            if record.opcode in DESCRIPTIONS:  # in case the first chunk is damaged
                with suppress(Damage), translate_parse_errors(record):
                    writer.index.take(record)
        self._load(lambda loaded: self._copy(writer, loaded), self._lose)

    def _load(self, take: Callable[[Loaded], None], lose: Callable[[Hole], None]) -> None:
        load_records(self._path, self._file, take, lose, is_verified=self.verified)

    def _lose(self, hole: Hole) -> None:
        self.damage.append(str(hole.damage))
        if self.cut:  # else it is in the summary, which is computed again
            self.bytes_lost += hole.bytes_lost
            # A cut at the end loses nothing if the ring holds the rest.
            self.lost = self.lost or not hole.at_end
        self.cut = self.cut and hole.opcode != Opcode.DATA_END

    def select_messages(self, topic: str, messages: NDArray[Any]) -> NDArray[Any]:
        """Return those of these messages that are to be copied: all, unless a subclass differs."""
        del topic
        return messages

    def _copy(self, writer: LogWriter, loaded: Loaded) -> None:
        record = loaded.record
        if not self.cut:  # what follows the data is computed again
            return
        match record.opcode:
            case Opcode.CHUNK:
                self._copy_chunk(writer, loaded)
            case Opcode.MESSAGE:  # another program wrote it in no chunk
                self._add(writer, self._choose(writer, record, loaded.parts))
                if writer.pending_bytes > _LOOSE_BYTES:
                    writer.end_chunk()
            case Opcode.SCHEMA | Opcode.CHANNEL:
                writer.index.take(record)
            case Opcode.ATTACHMENT:
                a = Attachment.read(record.stream())
                self._refuse_unchecked(record, record.body[-4:] != NO_CHECKSUM)
                writer.attachment(a.name, a.data, a.log_time, a.media_type)
            case Opcode.METADATA:
                metadata = Metadata.read(record.stream())
                writer.metadata(metadata.name, metadata.metadata)
                self._metadata[metadata.name] = None
            case Opcode.DATA_END:
                self.cut = False

    def _copy_chunk(self, writer: LogWriter, loaded: Loaded) -> None:
        chunk, parts = loaded.chunk, loaded.parts
        assert chunk is not None
        self._refuse_unchecked(loaded.record, chunk.uncompressed_crc != 0)
        for part in _find_descriptions(parts):
            writer.index.take(part)
        chosen = self._choose(writer, loaded.record, parts)
        count = sum(len(part.records) for part in parts if isinstance(part, MessageRun))
        if sum(len(kept) for _, kept in chosen) == count:
            chunk.uncompressed_crc = chunk.uncompressed_crc or zlib.crc32(loaded.content)
            writer.copy_chunk(chunk, parts)
            return
        self._add(writer, chosen)
        writer.end_chunk()

    def _add(self, writer: LogWriter, chosen: Iterable[tuple[int, NDArray[Any]]]) -> None:
        for channel, kept in chosen:
            writer.add(channel, kept.copy())

    def _refuse_unchecked(self, record: FileRecord, checked: bool) -> None:
        """Raise Damage for parts without a checksum: a block of zeros would look like that."""
        if not (checked or self.verified):
            raise Damage(record.start, "it has no checksum: damage would not be noticed")

    def _choose(
        self, writer: LogWriter, record: FileRecord, parts: Sequence[Part]
    ) -> list[tuple[int, NDArray[Any]]]:
        """Return each run's channel and those of its messages that are to be copied; count them.

        Raise Damage if a channel is not known: it was described in a lost part.
        """
        runs = [part for part in parts if isinstance(part, MessageRun)]
        if not all(writer.index.knows(run.channel) for run in runs):
            self._look_ahead(writer, record)
        chosen, counts = [], Counter[str]()
        for run in runs:
            if not writer.index.knows(run.channel):
                raise Damage(record.start, f"channel {run.channel} was described in a lost part")
            topic = writer.index.channels[run.channel].topic
            kept = self.select_messages(topic, run.records)
            chosen.append((run.channel, kept))
            if len(kept):
                counts[topic] += len(kept)
        self.saved += counts
        return chosen

    def _look_ahead(self, writer: LogWriter, first: FileRecord) -> None:
        """Learn the channels from the chunks from `first` on: the first description counts."""
        if self._has_looked_ahead:
            return
        self._has_looked_ahead = True

        def learn(loaded: Loaded) -> None:
            if loaded.chunk is not None and loaded.record.start >= first.start:
                for description in _find_descriptions(loaded.parts):
                    writer.index.take(description)

        self._load(learn, lambda hole: None)


class ResumedLog(NamedTuple):
    """A log that goes on behind the last whole chunk of its file."""

    writer: LogWriter
    damage: str
    """Why the file ended there; empty where it was finished."""
    last_tick: int
    """The last tick that is in the file, and the last row of all that is no tick."""
    last_row: int


def resume_log(
    path: Path, stream: BufferedWriter | BufferedRandom, beat: Callable[[], object] = lambda: None
) -> ResumedLog:
    """Go on with a log whose writer has died, or that is finished; `stream` has the file at `path`.

    What follows the last whole chunk is cut off, and so is a summary. `beat` is called for each
    record that is read. Raise Damage if something before the end is damaged: then the file is as
    it was.
    """
    if path.stat().st_size <= len(MAGIC):
        stream.truncate(0)
        return ResumedLog(LogWriter(stream), "nothing was in it", NO_TICK, NO_ROW)
    writer = LogWriter(stream, begins=False)
    file = map_log_file(path)
    last_tick, last_row = NO_TICK, NO_ROW
    damage, ended = "", False

    def take(loaded: Loaded) -> None:
        nonlocal ended, last_tick, last_row
        beat()
        ended = ended or loaded.record.opcode == Opcode.DATA_END
        if ended:
            return
        writer.take_over(loaded)
        for run in (part for part in loaded.parts if isinstance(part, MessageRun)):
            topic = writer.index.channels[run.channel].topic
            if topic == TICK_TOPIC:
                last_tick = max(last_tick, int(run.records["sequence"].max()))
            elif topic in JSON_SCHEMAS:
                rows = (message.get("row", NO_ROW) for message in parse_messages(run.records))
                last_row = max(last_row, *rows)

    def lose(hole: Hole) -> None:
        nonlocal damage
        if not ended and not hole.at_end:
            raise hole.damage
        damage = damage if ended else str(hole.damage)

    load_records(path, file, take, lose)
    writer.go_on(lambda size: compute_checksum(file[:size]))
    return ResumedLog(writer, damage, last_tick, last_row)


def _find_descriptions(parts: Iterable[Part]) -> list[FileRecord]:
    """Return the schemas and channels that a chunk describes."""
    return [p for p in parts if isinstance(p, FileRecord) and p.opcode in DESCRIPTIONS]
