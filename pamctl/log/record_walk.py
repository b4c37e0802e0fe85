"""The one walk over a log file: every record in order, verified, and every damage.

Who reads strictly stops at the first damage. Who checks or repairs goes on behind it, at the next
chunk whose own checksum is right: nothing is taken for a chunk by chance.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Chunk

from pamctl.log.chunks import (
    Part,
    Unpacker,
    find_message_run,
    read_chunk,
    read_chunk_content,
)
from pamctl.log.framing import (
    HELD_BYTES,
    MAGIC,
    Damage,
    FileRecord,
    record_at,
    release_pages,
    translate_parse_errors,
    verify_checksum,
)

_CHUNK_FRAME = re.compile(rb"(?=\x06.{4}\x00{4}.{28}(?:\x00|[\x03\x04])\x00{3})", re.DOTALL)
"""A chunk's opcode, a length below 4 GiB, its times, size and checksum, and the length of "",
"lz4" or "zstd"."""


class Hole(NamedTuple):
    """A damaged record, or a place where no record can be found."""

    damage: Damage
    bytes_lost: int
    at_end: bool
    """Whether nothing is found after it."""
    opcode: int = 0
    """Kind of the damaged record; 0 where there is none."""


class Loaded(NamedTuple):
    """A record whose checksum is right."""

    record: FileRecord
    parts: list[Part]
    """What it holds: itself, or messages, or the content of a chunk."""
    chunk: Chunk | None = None
    content: memoryview = memoryview(b"")
    """The chunk's records as bytes."""


def load_records(
    path: Path,
    file: memoryview,
    take: Callable[[Loaded], None],
    lose: Callable[[Hole], None],
    *,
    is_verified: bool = False,
) -> None:
    """Give each sound record of a file to `take`, and tell `lose` of each damage.

    What `take` cannot parse is damage, too. Whatever `lose` raises ends the walk. `is_verified`:
    the checksum of all data is known to be right. Raise LogError for a file that unpacks to too
    much.
    """
    unpacker = Unpacker(path, file)
    for found in find_records(file):
        if isinstance(found, Hole):
            lose(found)
            continue
        try:
            with translate_parse_errors(found):
                if not (is_verified and found.opcode == Opcode.DATA_END):
                    verify_checksum(file, found)
                take(_load(file, found, unpacker))
        except Damage as damage:
            lost = 0 if found.opcode == Opcode.DATA_END else found.end - found.start
            lose(Hole(damage, lost, at_end=False, opcode=found.opcode))


def _load(file: memoryview, record: FileRecord, unpacker: Unpacker) -> Loaded:
    if record.opcode == Opcode.MESSAGE:  # another program wrote it in no chunk
        return Loaded(record, [find_message_run(file[: record.end], record)])
    if record.opcode != Opcode.CHUNK:
        return Loaded(record, [record])
    chunk, content, parts = unpacker.unpack(record)
    return Loaded(record, parts, chunk, content)


def walk_records(file: memoryview) -> Iterator[FileRecord]:
    """Yield a file's records, the footer last; raise Damage if no next record can be found."""
    for found in find_records(file):
        if isinstance(found, Hole):
            raise found.damage
        yield found


def find_records(file: memoryview) -> Iterator[FileRecord | Hole]:
    """Yield records and holes in order, to the footer or the end of the file."""
    if file[: len(MAGIC)] != MAGIC:
        yield Hole(Damage(0, "it does not begin as an MCAP file does"), 0, at_end=False)
    at = last = len(MAGIC)
    held_at, in_data = 0, True
    while True:
        try:
            record = record_at(file, at)
            # Opcodes from 128 on are free for private use.
            if Opcode.DATA_END < record.opcode < 128:
                raise Damage(at, f"there is no record of kind {record.opcode}")
        except Damage as damage:
            # The previous record may have had a wrong length, and may hide a chunk.
            found = _find_next_chunk(file, last + 1) if in_data else None
            if found is None:
                yield Hole(damage, len(file) - at if in_data else 0, at_end=True)
                return
            yield Hole(damage, max(0, found.start - at), at_end=False)
            record = found
        yield record
        at, last = record.end, record.start
        in_data = in_data and record.opcode != Opcode.DATA_END
        if at - held_at > HELD_BYTES:
            release_pages(file, held_at, at)
            held_at = at
        if record.opcode == Opcode.FOOTER:
            break
    if in_data:
        what = "the record at the end of the data, with their checksum, is missing"
        yield Hole(Damage(at, what), 0, at_end=True)
    elif file[at:] != MAGIC:
        yield Hole(Damage(at, "it does not end as an MCAP file does"), 0, at_end=True)


def _find_next_chunk(file: memoryview, at: int) -> FileRecord | None:
    for match in _CHUNK_FRAME.finditer(file, at):
        with suppress(Exception):  # a parser may raise anything for bytes that are not a chunk
            record = record_at(file, match.start())
            chunk = read_chunk(record)
            if chunk.uncompressed_crc and read_chunk_content(chunk):
                return record
    return None
