"""The one walk over a log file: every record in order, verified, its chunks unpacked.

Who reads strictly stops at the first damage. Who checks or repairs goes on behind it, at the next
chunk whose own checksum is right: nothing is taken for a chunk by chance. Small files that unpack
to huge ones, or to countless tiny records, are refused. Messages are numpy arrays.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk
from numpy.typing import NDArray

from pamctl.base.texts import from_json
from pamctl.log.framing import (
    HELD_BYTES,
    MAGIC,
    Damage,
    FileRecord,
    LogError,
    record_at,
    release_pages,
    translate_parse_errors,
    verify_checksum,
)

MOST_CHUNK_BYTES = 1 << 26
"""What a compressed chunk may hold: 16 times the largest that common writers make by default."""
MOST_SILENT_BYTES = 1 << 29
MOST_TIMES_PACKED = 20
"""A file that unpacks to more than `MOST_SILENT_BYTES` and to more than so many times its own
bytes is refused. Ticks of a real run unpack to some three times theirs, of one at rest to ten."""
MOST_PARTS = 1 << 17
"""Records in chunks, messages that are alike counted as one. A file that holds more of them, and
more than one in `BYTES_OF_PART` of its own bytes, is refused: each costs some 10 us."""
BYTES_OF_PART = 16

_CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last time, unpacked size, checksum, length of the compression's name."""


def read_chunk(record: FileRecord) -> Chunk:
    """Return a chunk, its data a view into the file; raise a parser's error if it is none."""
    start, end, size, crc, named = _CHUNK_HEAD.unpack_from(record.body)
    name_ends = _CHUNK_HEAD.size + named
    data = record.body[name_ends + 8 :]
    length = int.from_bytes(record.body[name_ends : name_ends + 8], "little")
    if len(data) < length:
        raise ValueError(f"a chunk of {length} bytes is cut short")
    return Chunk(
        compression=bytes(record.body[_CHUNK_HEAD.size : name_ends]).decode(),
        data=data[:length],  # type: ignore[arg-type]
        message_start_time=start,
        message_end_time=end,
        uncompressed_crc=crc,
        uncompressed_size=size,
    )


class Unpacker:
    """Unpacks the chunks of one file, and refuses a small file that unpacks to a lot."""

    def __init__(self, path: Path, file: memoryview) -> None:
        """`file` is what the file at `path` holds."""
        self._path, self._file_bytes = path, len(file)
        self._unpacked_bytes = self._parts = 0

    def unpack(self, record: FileRecord) -> tuple[Chunk, memoryview, list[Part]]:
        """Return a chunk, its records as bytes, and those records.

        Raise a parser's error if they are not as written, LogError if the file unpacks to too much.
        """
        chunk = read_chunk(record)
        content = memoryview(read_chunk_content(chunk))
        self._unpacked_bytes += len(content)
        most_bytes = max(MOST_SILENT_BYTES, MOST_TIMES_PACKED * self._file_bytes)
        if self._unpacked_bytes > most_bytes:
            self._refuse(f"{most_bytes / 1e6:.0f} MB", f"is packed {MOST_TIMES_PACKED} to 1")
        parts: list[Part] = []
        most_parts = max(MOST_PARTS, self._file_bytes // BYTES_OF_PART)
        for part in walk_messages(content):
            parts.append(part)
            if self._parts + len(parts) > most_parts:
                self._refuse(f"{most_parts} records that differ", "holds so many")
        self._parts += len(parts)
        return chunk, content, parts

    def _refuse(self, size: str, what: str) -> NoReturn:
        raise LogError(
            f"{self._path} has {self._file_bytes / 1e6:.3g} MB and unpacks to more than {size}: "
            f"no run's log {what}, so the rest is not unpacked; "
            "delete it if you do not know where it comes from"
        )


def read_chunk_content(chunk: Chunk) -> bytes:
    """Return a chunk's records as bytes; raise a parser's error if they are not as written.

    No more is unpacked than the chunk declares: a kilobyte may hold a gigabyte.
    """
    size, data = chunk.uncompressed_size, chunk.data
    if chunk.compression and size > MOST_CHUNK_BYTES:
        limit = f"the limit is {MOST_CHUNK_BYTES >> 20} MB"
        raise ValueError(f"a chunk declares {size / 2**20:.1f} MB, {limit}")
    if chunk.compression == "zstd":
        # What the frame itself declares would overrule the chunk.
        declared = zstandard.get_frame_parameters(data).content_size
        is_larger = declared not in (size, zstandard.CONTENTSIZE_UNKNOWN)
        content = b"" if is_larger else zstandard.decompress(data, size)
    elif chunk.compression == "lz4":
        import lz4.frame  # no log of pamctl needs it

        content = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
    elif chunk.compression:
        raise ValueError(f"a chunk is compressed with {chunk.compression}")
    else:
        content, size = data, len(data)
    if len(content) != size:
        raise ValueError(f"a chunk does not hold the {size} bytes that it declares")
    if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise ValueError("the checksum of a chunk is wrong")
    return content


# --- messages -----------------------------------------------------------------------------------

_MESSAGE_HEADER = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
BODY_AT = np.dtype(_MESSAGE_HEADER).itemsize
"""Bytes of a message record before its body."""
_KIND_BYTES = 11
"""Bytes of a message's head up to its sequence: messages that share them are alike."""


@lru_cache(64)
def message_type(body_bytes: int) -> np.dtype[Any]:
    """Return the numpy type of a message record with so many bytes after its head."""
    return np.dtype([*_MESSAGE_HEADER, ("body", f"V{body_bytes}")])


class MessageRun(NamedTuple):
    """Messages of one channel and one length that follow one another."""

    channel: int
    start: int
    """Where the first begins in its chunk or file."""
    records: NDArray[Any]
    """A view, shape (n,): opcode, length, channel, sequence, log_time, publish_time, body."""


Part = FileRecord | MessageRun


def find_message_run(data: memoryview, first: FileRecord) -> MessageRun:
    """Return the messages of `data` from `first` on that have its channel and its length."""
    size, begin = first.end - first.start, first.start
    is_alone = data[begin : begin + _KIND_BYTES] != data[first.end : first.end + _KIND_BYTES]
    count = 1 if is_alone else (len(data) - begin) // size
    records = np.frombuffer(data, message_type(size - BODY_AT), count, begin)
    octets = np.frombuffer(data, np.uint8, count * size, begin).reshape(count, size)
    checked, window = 1, 512
    while checked < count:  # further and further ahead: channels may take turns
        ahead = octets[checked : checked + window, :_KIND_BYTES]
        alike = (ahead == octets[0, :_KIND_BYTES]).all(axis=1)
        if not alike.all():
            records = records[: checked + int(alike.argmin())]
            break
        checked, window = checked + window, 8 * window
    return MessageRun(int(records["channel"][0]), begin, records)


def walk_messages(chunk: memoryview) -> Iterator[Part]:
    """Yield the records of a chunk in order, similar messages together."""
    at = 0
    while at < len(chunk):
        record = record_at(chunk, at)
        if record.opcode == Opcode.MESSAGE:
            run = find_message_run(chunk, record)
            yield run
            at += run.records.nbytes
        else:
            yield record
            at = record.end


LONGEST_JSON_BYTES = 1 << 20
"""Of an event, gains or a state; parsed, they take many times their bytes."""


def parse_messages(records: NDArray[Any]) -> list[Any]:
    """Parse JSON messages of one length, shape (n,); raise ValueError for what no run writes."""
    if records.itemsize > LONGEST_JSON_BYTES:
        raise ValueError(f"a JSON message has {records.itemsize / 1e6:.3g} MB")
    return [from_json(body.tobytes()) for body in records["body"]]


# --- the walk -----------------------------------------------------------------------------------

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
        foreign = (
            "it does not begin as an MCAP file does; `pamctl log import FILE LOG` reads others"
        )
        yield Hole(Damage(0, foreign), 0, at_end=False)
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
