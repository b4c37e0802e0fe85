"""Add a metadata record to a finished log.

Every byte of the data stays: the record goes behind them, and only the end of the file, its
index, is written anew. The new file is complete before it takes the place of the old one, so
that a full disk or a power cut leaves the log as it was. The checksum of the data is continued
from the stored one: damage that was there before is still found.

Why not a file beside the log: it would be left behind when the log is copied or sent.
"""

from __future__ import annotations

import os
import shutil
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, Metadata, MetadataIndex, Statistics

from pamctl.log.annotate.annotation import ANNOTATION, Annotation, date_record
from pamctl.log.container import encode_record, encode_summary
from pamctl.log.framing import (
    FRAME,
    MAGIC,
    Damage,
    FileRecord,
    LogError,
    map_log_file,
    records_in,
    translate_parse_errors,
    walk_records,
)
from pamctl.new_file import create_new_file

_BLOCK_BYTES = 1 << 20


def write_annotation(path: Path, said: Annotation) -> None:
    """Say this of a run from now on; raise LogError or NewFileError if its log cannot be changed.

    The log must be finished.
    """
    append_metadata(path, ANNOTATION, date_record(said.to_metadata()))


def append_metadata(path: Path, name: str, values: Mapping[str, str]) -> None:
    """Add a metadata record to a finished log."""
    path = Path(os.path.realpath(path))
    end = _make_end(path, Metadata(name=name, metadata=dict(values)))
    before = path.stat()
    with create_new_file(path, replaces="") as stream:
        with path.open("rb") as log:
            _copy_bytes(log, stream, end.data_bytes)
        stream.write(end.tail)
        shutil.copymode(path, stream.name)
        with suppress(OSError, AttributeError):  # only root can, and Windows has no such owners
            os.chown(stream.name, before.st_uid, before.st_gid)
        if path.stat().st_size != before.st_size:
            raise LogError(f"{path} has changed meanwhile; try again")
    with suppress(OSError):  # the time of the measurement, for those who sort by it
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


class _NewEnd(NamedTuple):
    data_bytes: int
    """Bytes of the old file that stay."""
    tail: bytes
    """The new record, the end of the data, the index and the footer."""


def _make_end(path: Path, metadata: Metadata) -> _NewEnd:
    try:
        file = map_log_file(path)
        ends = [r for r in walk_records(file) if r.opcode in (Opcode.DATA_END, Opcode.FOOTER)]
        data_end, footer = ends[0], ends[-1]
        with translate_parse_errors(footer):
            return _replace_end(file, data_end, footer, metadata)
    except Damage as damage:
        fix = f"save the undamaged part with `pamctl log recover {path} DESTINATION`"
        raise LogError(f"{path} is damaged, or not finished: {damage}; {fix}") from damage


def _replace_end(
    file: memoryview, data_end: FileRecord, footer: FileRecord, metadata: Metadata
) -> _NewEnd:
    added = encode_record(metadata)
    crc = DataEnd.read(data_end.stream()).data_section_crc
    data = added + encode_record(DataEnd(zlib.crc32(added, crc) if crc else 0))
    start = data_end.start + len(data)
    index = MetadataIndex(offset=data_end.start, length=len(added), name=metadata.name)
    if not Footer.read(footer.stream()).summary_start:
        return _NewEnd(data_end.start, data + encode_record(Footer(0, 0, 0)) + MAGIC)
    old = records_in(file[: footer.start], data_end.end)
    return _NewEnd(data_end.start, data + _make_summary(start, old, index))


def _make_summary(start: int, old: Iterable[FileRecord], index: MetadataIndex) -> bytes:
    """Return the summary with one metadata record more, the footer and the end of the file."""
    groups: dict[int, bytes] = {}
    for record in old:
        data = FRAME.pack(record.opcode, len(record.body)) + record.body
        if record.opcode == Opcode.STATISTICS:
            statistics = Statistics.read(record.stream())
            statistics.metadata_count += 1
            data = encode_record(statistics)
        if record.opcode != Opcode.SUMMARY_OFFSET:
            groups[record.opcode] = groups.get(record.opcode, b"") + data
    groups[Opcode.METADATA_INDEX] = groups.get(Opcode.METADATA_INDEX, b"") + encode_record(index)
    return encode_summary(start, groups.items())


def _copy_bytes(source: BinaryIO, target: BinaryIO, count: int) -> None:
    while count and (block := source.read(min(count, _BLOCK_BYTES))):
        target.write(block)
        count -= len(block)
