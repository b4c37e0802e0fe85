"""Say something of a finished log, and read what was said: a metadata record behind its data.

Every byte of the data stays: only the end of the file, its index, is written anew. The new file is
complete before it takes the place of the old one, so that a full disk or a power cut leaves the
log as it was. The checksum of the data is continued from the stored one: damage that was there
before is still found.

Why not a file beside the log: it would be left behind when the log is copied or sent.
"""

from __future__ import annotations

import os
import shutil
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, Metadata, MetadataIndex, Statistics

from pamctl.log.annotation import ANNOTATION, Annotation, date_record
from pamctl.log.framing import (
    MAGIC,
    Damage,
    FileRecord,
    LogError,
    encode_record,
    encode_summary,
    map_log_file,
    records_in,
    translate_parse_errors,
)
from pamctl.log.reading.record_walk import walk_records
from pamctl.new_file import create_new_file

__all__ = ["LogError", "append_metadata", "read_annotation", "write_annotation"]

_BLOCK_BYTES = 1 << 20


def read_annotation(path: Path) -> Annotation:
    """Return what is said of a run, from its metadata alone; raise LogError if it is no log.

    A log that is not finished says what stands before its end.
    """
    values: Mapping[str, str] = {}
    try:
        for record in walk_records(map_log_file(path)):
            if record.opcode == Opcode.METADATA:
                with translate_parse_errors(record):
                    metadata = Metadata.read(record.stream())
                values = metadata.metadata if metadata.name == ANNOTATION else values
    except Damage as damage:
        if damage.offset == 0:
            raise LogError(f"{path} is not a log: {damage}") from damage
    return Annotation.from_metadata(values)


def write_annotation(path: Path, said: Annotation) -> None:
    """Say this of a run from now on; raise LogError or NewFileError if its log cannot be changed.

    The log must be finished.
    """
    append_metadata(path, ANNOTATION, date_record(said.to_metadata()))


def append_metadata(path: Path, name: str, values: Mapping[str, str]) -> None:
    """Add a metadata record to a finished log."""
    path = Path(os.path.realpath(path))
    data_bytes, tail = _make_end(path, Metadata(name=name, metadata=dict(values)))
    before = path.stat()
    with create_new_file(path, replaces="") as stream:
        with path.open("rb") as log:
            _copy_bytes(log, stream, data_bytes)
        stream.write(tail)
        shutil.copymode(path, stream.name)
        with suppress(OSError, AttributeError):  # only root can, and Windows has no such owners
            os.chown(stream.name, before.st_uid, before.st_gid)
        if path.stat().st_size != before.st_size:
            raise LogError(f"{path} has changed meanwhile; try again")
    with suppress(OSError):  # the time of the measurement, for those who sort by it
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def _make_end(path: Path, metadata: Metadata) -> tuple[int, bytes]:
    """Return how many bytes of the file stay, and all that follows them then."""
    try:
        file = map_log_file(path)
        ends = [r for r in walk_records(file) if r.opcode in (Opcode.DATA_END, Opcode.FOOTER)]
        data_end, footer = ends[0], ends[-1]
        with translate_parse_errors(footer):
            added = encode_record(metadata)
            crc = DataEnd.read(data_end.stream()).data_section_crc
            data = added + encode_record(DataEnd(zlib.crc32(added, crc) if crc else 0))
            if not Footer.read(footer.stream()).summary_start:
                return data_end.start, data + encode_record(Footer(0, 0, 0)) + MAGIC
            index = MetadataIndex(offset=data_end.start, length=len(added), name=metadata.name)
            old = records_in(file[: footer.start], data_end.end)
            summary = _add_to_summary(old, index)
            start = data_end.start + len(data)
            return data_end.start, data + encode_summary(start, summary.items())
    except Damage as damage:
        fix = f"save the undamaged part with `pamctl log recover {path} DESTINATION`"
        raise LogError(f"{path} is damaged, or not finished: {damage}; {fix}") from damage


def _add_to_summary(old: Iterable[FileRecord], index: MetadataIndex) -> dict[int, bytes]:
    """Return the records of the summary by kind, with one metadata record more."""
    groups: dict[int, bytes] = {}
    for record in old:
        data = record.frame()
        if record.opcode == Opcode.STATISTICS:
            statistics = Statistics.read(record.stream())
            statistics.metadata_count += 1
            data = encode_record(statistics)
        if record.opcode != Opcode.SUMMARY_OFFSET:
            groups[record.opcode] = groups.get(record.opcode, b"") + data
    groups[Opcode.METADATA_INDEX] = groups.get(Opcode.METADATA_INDEX, b"") + encode_record(index)
    return groups


def _copy_bytes(source: BinaryIO, target: BinaryIO, count: int) -> None:
    while count and (block := source.read(min(count, _BLOCK_BYTES))):
        target.write(block)
        count -= len(block)
