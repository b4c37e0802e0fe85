"""Split a log file into records and verify checksums; the meaning of a record is not known here.

Records are views into the file: nothing is copied. Checksums cover every byte of a log that
pamctl finished, and all of them are verified.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer

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


def verify_checksum(file: memoryview, record: FileRecord) -> None:
    """Verify the checksum of a record, if it holds one; raise Damage if it is wrong.

    A chunk's own checksum is verified by `unpack_chunk`.
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


def unpack_chunk(chunk: FileRecord) -> memoryview:
    """Return a chunk's records as bytes; raise Damage if they are not as written."""
    with translate_parse_errors(chunk):
        return memoryview(read_chunk_content(Chunk.read(chunk.stream())))


MOST_CHUNK_BYTES = 1 << 26
"""What a compressed chunk may hold: 16 times the largest that common writers make by default."""


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
