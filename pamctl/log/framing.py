"""The records of a log file, their checksums, and its end; what a record means is not known here.

Records are views into the file: nothing is copied. Checksums cover every byte of a log that
pamctl finished, and all of them are verified.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, McapRecord

from pamctl.base.errors import ExitCode
from pamctl.base.new_file import describe_irregular_file

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


HELD_BYTES = 1 << 24
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
    if stored not in (int.from_bytes(NO_CHECKSUM), compute_checksum(data)):
        raise Damage(record.start, f"the checksum of {what} is wrong")


def compute_checksum(data: memoryview) -> int:
    """Return the CRC of a part of a file; only that of all the data is long."""
    crc, is_long = 0, len(data) > HELD_BYTES
    for begin in range(0, len(data), HELD_BYTES):
        part = data[begin : begin + HELD_BYTES]
        crc = zlib.crc32(part, crc)
        if is_long:  # then it begins where the file does
            release_pages(data, begin, begin + len(part))
    return crc


# --- the end of a file -------------------------------------------------------------------------

_FOOTER_BYTES = FRAME.size + 20
_DATA_END_BYTES = FRAME.size + 4


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
