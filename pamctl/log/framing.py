"""Split a log file into records and verify checksums; the meaning of a record is not known here.

Records are views into the file: nothing is copied. Checksums cover every byte of a log that
pamctl finished, and all of them are verified. `walk_records` stops at the first damage;
`salvage_records` goes on behind it, at the next chunk whose own checksum is right.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer, McapRecord, SummaryOffset

from pamctl.exit_codes import ExitCode
from pamctl.regular_file import describe_irregular_file

MAGIC = b"\x89MCAP0\r\n"
"""The begin and the end of every MCAP file. Only `mcap.writer` has it, which no reader needs."""
FRAME = struct.Struct("<BQ")
"""Opcode, and number of bytes in the body after it."""
NO_CHECKSUM = bytes(4)
"""A stored checksum of zero: the writer did not compute it."""


class LogError(Exception):
    """A log cannot be read or written. The message says what, where, and what to do."""

    exit_code = ExitCode.BAD_DATA


class Damage(Exception):
    """The bytes at `offset` of the file are wrong."""

    def __init__(self, offset: int, what: str) -> None:
        """`what` completes the sentence "at byte N, ..."."""
        super().__init__(f"at byte {offset}, {what}")
        self.offset = offset


class FileRecord(NamedTuple):
    """One record. `body` excludes the frame; `start` and `end` include it."""

    opcode: int
    start: int
    end: int
    body: memoryview

    def stream(self) -> ReadDataStream:
        """Return the body as a stream for the parsers of the `mcap` package."""
        return ReadDataStream(BytesIO(self.body))

    def frame(self) -> bytes:
        """Return the whole record as it stands in the file."""
        return FRAME.pack(self.opcode, len(self.body)) + self.body


def encode_record(record: McapRecord) -> bytes:
    """Return a record as bytes, its frame included."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def map_log_file(path: Path) -> memoryview:
    """Map a log file for reading; raise LogError if that is not possible."""
    if something := describe_irregular_file(path):
        raise LogError(f"cannot read {path}: it is {something}")
    try:
        with path.open("rb") as file:
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise LogError(f"{path} is empty: no log was written there") from error


_HELD_BYTES = 1 << 24
"""Of a file that is read in order, at most so much stays mapped in memory."""


def release_pages(file: memoryview, begin: int, end: int) -> None:
    """Take a part of a mapped file out of this process's memory; it may be read again.

    The kernel keeps what it has of the file. Without this a long log counts as memory in use.
    """
    mapped = file.obj
    if isinstance(mapped, mmap.mmap) and hasattr(mapped, "madvise"):  # Windows has none
        begin -= begin % mmap.PAGESIZE
        mapped.madvise(mmap.MADV_DONTNEED, begin, end - begin)


def record_at(data: memoryview, at: int) -> FileRecord:
    """Return the record at an offset; raise Damage if it is not whole."""
    if at + FRAME.size > len(data):
        raise Damage(at, "the file is cut short")
    opcode, length = FRAME.unpack_from(data, at)
    start, end = at + FRAME.size, at + FRAME.size + length
    if opcode == 0:
        raise Damage(at, "there are only zeros")
    if end > len(data):
        raise Damage(at, f"a record of {length} bytes is cut short")
    return FileRecord(opcode, at, end, data[start:end])


def records_in(data: memoryview, at: int = 0) -> Iterator[FileRecord]:
    """Yield the records from an offset to the end; raise Damage if no next one can be found."""
    while at < len(data):
        record = record_at(data, at)
        yield record
        at = record.end


def walk_records(file: memoryview) -> Iterator[FileRecord]:
    """Yield a file's records, the footer last; raise Damage if no next record can be found."""
    if file[: len(MAGIC)] != MAGIC:
        raise Damage(0, "it does not begin as an MCAP file does")
    at, opcode, has_data_end, held_at = len(MAGIC), 0, False, 0
    while opcode != Opcode.FOOTER:
        record = record_at(file, at)
        yield record
        at, opcode = record.end, record.opcode
        if at - held_at > _HELD_BYTES:
            release_pages(file, held_at, at)
            held_at = at
        has_data_end |= opcode == Opcode.DATA_END
    if not has_data_end:
        raise Damage(at, "the record at the end of the data, with their checksum, is missing")
    if file[at:] != MAGIC:
        raise Damage(at, "it does not end as an MCAP file does")


# --- checksums ----------------------------------------------------------------------------------


def verify_checksum(file: memoryview, record: FileRecord) -> None:
    """Verify the checksum of a record, if it holds one; raise Damage if it is wrong.

    A chunk's own checksum is verified when it is unpacked.
    """
    if record.opcode == Opcode.ATTACHMENT:
        stored = int.from_bytes(record.body[-4:], "little")
        _compare_checksum(record, "an attachment", stored, record.body[:-4])
    elif record.opcode == Opcode.DATA_END:
        stored = DataEnd.read(record.stream()).data_section_crc
        _compare_checksum(record, "all before it", stored, file[: record.start])
    elif record.opcode == Opcode.FOOTER:
        footer = Footer.read(record.stream())
        summary = file[footer.summary_start or record.start : record.end - 4]
        _compare_checksum(record, "the summary", footer.summary_crc, summary)


@contextmanager
def translate_parse_errors(record: FileRecord) -> Iterator[None]:
    """Turn every error of a parser into Damage: the record's bytes are wrong."""
    try:
        yield
    except (Damage, LogError):
        raise
    except Exception as error:
        what = f"a record makes no sense ({type(error).__name__}: {error})"
        raise Damage(record.start, what) from error


def _compare_checksum(record: FileRecord, what: str, stored: int, data: memoryview) -> None:
    if stored not in (int.from_bytes(NO_CHECKSUM), _compute_checksum(data)):
        raise Damage(record.start, f"the checksum of {what} is wrong")


def _compute_checksum(data: memoryview) -> int:
    """Return the CRC of a part of a file; only that of all the data is long."""
    crc, is_long = 0, len(data) > _HELD_BYTES
    for begin in range(0, len(data), _HELD_BYTES):
        part = data[begin : begin + _HELD_BYTES]
        crc = zlib.crc32(part, crc)
        if is_long:  # then it begins where the file does
            release_pages(data, begin, begin + len(part))
    return crc


# --- chunks -------------------------------------------------------------------------------------

MOST_CHUNK_BYTES = 1 << 26
"""What a compressed chunk may hold: 16 times the largest that common writers make by default."""
MOST_SILENT_BYTES = 1 << 29
MOST_TIMES_PACKED = 100
"""A file that unpacks to more than `MOST_SILENT_BYTES` and to more than so many times its own
bytes is refused. Ticks of a real run unpack to some three times theirs, of one at rest to ten."""


class Unpacker:
    """Unpacks the chunks of one file, and refuses a small file that unpacks to a huge one."""

    def __init__(self, path: Path, file: memoryview) -> None:
        self._path, self._file_bytes = path, len(file)
        self._unpacked = 0

    def unpack(self, record: FileRecord) -> tuple[Chunk, memoryview]:
        """Return a chunk, and its records as bytes; raise Damage if they are not as written.

        Raise LogError if the file unpacks to too much.
        """
        with translate_parse_errors(record):
            chunk = Chunk.read(record.stream())
            content = read_chunk_content(chunk)
        self._unpacked += len(content)
        if self._unpacked > max(MOST_SILENT_BYTES, MOST_TIMES_PACKED * self._file_bytes):
            raise LogError(
                f"{self._path} has {self._file_bytes / 1e6:.3g} MB and unpacks to more than "
                f"{self._unpacked / 1e6:.0f} MB: no run's log is packed {MOST_TIMES_PACKED} to 1, "
                "so the rest is not unpacked; delete it if you do not know where it comes from"
            )
        return chunk, memoryview(content)


def read_chunk_content(chunk: Chunk) -> bytes:
    """Return a chunk's records as bytes; raise a parser's error if they are not as written."""
    content = _decompress(chunk)
    if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise ValueError("the checksum of a chunk is wrong")
    return content


def _decompress(chunk: Chunk) -> bytes:
    """Decompress no more than a chunk declares: a kilobyte may hold a gigabyte."""
    size, data = chunk.uncompressed_size, chunk.data
    if chunk.compression == "":
        return data
    if size > MOST_CHUNK_BYTES:
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
    else:
        raise ValueError(f"a chunk is compressed with {chunk.compression}")
    if len(content) != size:
        raise ValueError(f"a chunk does not hold the {size} bytes that it declares")
    return content


def encode_summary(start: int, groups: Iterable[tuple[int, bytes]]) -> bytes:
    """Return all that follows the data of a file: the summary, the footer, the magic bytes.

    `start` is where it will stand; a group has the encoded records of one opcode.
    """
    summary = offsets = b""
    for opcode, group in groups:
        offset = SummaryOffset(opcode, start + len(summary), len(group))
        offsets += encode_record(offset) if group else b""
        summary += group
    footer = Footer(start, start + len(summary) if offsets else 0, 0)
    summary += offsets
    footer.summary_crc = zlib.crc32(summary + encode_record(footer)[: -len(NO_CHECKSUM)])
    return summary + encode_record(footer) + MAGIC


# --- behind damage ------------------------------------------------------------------------------

_CHUNK_FRAME = re.compile(rb"(?=\x06.{4}\x00{4})", re.DOTALL)
"""A chunk's opcode, and a length below 4 GiB."""
_FOOTER_BYTES = FRAME.size + 20
_DATA_END_BYTES = FRAME.size + 4


class Hole(NamedTuple):
    """A place where no record can be found."""

    damage: Damage
    bytes_lost: int
    at_end: bool
    """Whether nothing is found after it."""


def salvage_records(file: memoryview) -> Iterator[FileRecord | Hole]:
    """Yield records and holes in order, to the footer or the end of the file.

    Behind a hole, a chunk is recognised by its own checksum: nothing is taken for one by chance.
    """
    if file[: len(MAGIC)] != MAGIC:
        yield Hole(Damage(0, "it does not begin as an MCAP file does"), 0, at_end=False)
    at = last = len(MAGIC)
    in_data = True
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
        if record.opcode == Opcode.FOOTER:
            if file[at:] != MAGIC:
                yield Hole(Damage(at, "it does not end as an MCAP file does"), 0, at_end=True)
            return


def _find_next_chunk(file: memoryview, at: int) -> FileRecord | None:
    for match in _CHUNK_FRAME.finditer(file, at):
        with suppress(Exception):  # a parser may raise anything for bytes that are not a chunk
            record = record_at(file, match.start())
            chunk = Chunk.read(record.stream())
            if chunk.uncompressed_crc and read_chunk_content(chunk):
                return record
    return None


def read_summary(file: memoryview) -> list[FileRecord]:
    """Return the records of the summary; none without a valid checksum."""
    with suppress(Damage):
        footer, stored = _find_footer(file)
        with translate_parse_errors(footer):
            if stored.summary_start and stored.summary_crc:
                verify_checksum(file, footer)
                return list(records_in(file[: footer.start], stored.summary_start))
    return []


def is_data_verified(file: memoryview) -> bool:
    """Tell whether the end of the file holds a valid checksum of all its data."""
    with suppress(Damage):
        footer, stored = _find_footer(file)
        behind = stored.summary_start or footer.start
        end = record_at(file, max(0, behind - _DATA_END_BYTES))
        with translate_parse_errors(end):
            verify_checksum(file, end)
            crc = DataEnd.read(end.stream()).data_section_crc
            return end.opcode == Opcode.DATA_END and crc != 0
    return False


def _find_footer(file: memoryview) -> tuple[FileRecord, Footer]:
    """Return the footer; raise Damage if there is none."""
    footer = record_at(file, max(0, len(file) - len(MAGIC) - _FOOTER_BYTES))
    if footer.opcode != Opcode.FOOTER:
        raise Damage(footer.start, "there is no footer")
    with translate_parse_errors(footer):
        return footer, Footer.read(footer.stream())
