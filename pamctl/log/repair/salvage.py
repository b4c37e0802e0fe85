"""Walk through a damaged file: its records, and after a hole the next undamaged chunk.

A chunk is recognised by its own checksum, so that nothing is taken for a chunk by chance.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer

from pamctl.log.framing import (
    FRAME,
    MAGIC,
    Damage,
    FileRecord,
    record_at,
    records_in,
    translate_parse_errors,
    unpack_chunk,
    verify_checksum,
)

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
    """Yield records and holes in order, to the footer or the end of the file."""
    if file[: len(MAGIC)] != MAGIC:
        yield Hole(Damage(0, "it does not begin as an MCAP file does"), 0, at_end=False)
    at = last = len(MAGIC)
    in_data = True
    while True:
        try:
            record = _known_record_at(file, at)
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


def read_summary(file: memoryview) -> list[FileRecord]:
    """Return the records of the summary; none without a valid checksum."""
    footer = _find_verified_footer(file)
    if footer is None:
        return []
    start = Footer.read(footer.stream()).summary_start
    return list(records_in(file[: footer.start], start))


def is_data_verified(file: memoryview) -> bool:
    """Tell whether the end of the file holds a valid checksum of all its data."""
    footer = _find_verified_footer(file)
    if footer is None:
        return False
    with suppress(Damage):
        end = record_at(file, Footer.read(footer.stream()).summary_start - _DATA_END_BYTES)
        with translate_parse_errors(end):
            verify_checksum(file, end)
            stored = DataEnd.read(end.stream()).data_section_crc
            return end.opcode == Opcode.DATA_END and stored != 0
    return False


def _find_verified_footer(file: memoryview) -> FileRecord | None:
    """Return the footer if it and its summary are undamaged."""
    with suppress(Damage):
        footer = record_at(file, max(0, len(file) - len(MAGIC) - _FOOTER_BYTES))
        with translate_parse_errors(footer):
            stored = Footer.read(footer.stream())
            if footer.opcode == Opcode.FOOTER and stored.summary_start and stored.summary_crc:
                verify_checksum(file, footer)
                return footer
    return None


def _known_record_at(file: memoryview, at: int) -> FileRecord:
    record = record_at(file, at)
    # Opcodes from 128 on are free for private use.
    if Opcode.DATA_END < record.opcode < 128:
        raise Damage(at, f"there is no record of kind {record.opcode}")
    return record


def _find_next_chunk(file: memoryview, at: int) -> FileRecord | None:
    for match in _CHUNK_FRAME.finditer(file, at):
        with suppress(Exception):  # a parser may raise anything for bytes that are not a chunk
            record = record_at(file, match.start())
            if Chunk.read(record.stream()).uncompressed_crc and len(unpack_chunk(record)):
                return record
    return None
