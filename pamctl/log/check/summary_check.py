"""Check that the summary at the end of a file matches the data, and that its offsets are right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    ChunkIndex,
    Footer,
    McapRecord,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)

from pamctl.log.check.log_problems import LogFindings
from pamctl.log.framing import FRAME, FileRecord

_PARSERS: Mapping[int, type[McapRecord]] = {
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.STATISTICS: Statistics,
}
_REPEATED = (Opcode.SCHEMA, Opcode.CHANNEL)


class SummaryCheck:
    """Follows the records after the data."""

    def __init__(self, findings: LogFindings) -> None:
        self._findings = findings
        self._stored: dict[int, list[Any]] = {}
        self._groups: list[SummaryOffset] = []
        self._stored_groups: list[SummaryOffset] = []

    def take(self, record: FileRecord) -> None:
        """Take the next record, the footer last."""
        if record.opcode == Opcode.SUMMARY_OFFSET:
            group = SummaryOffset.read(record.stream())
            self._stored_groups += [group] if group.group_length else []
        elif record.opcode == Opcode.FOOTER:
            self._check_footer(Footer.read(record.stream()), record)
        else:
            self._take_indexed(record)
            self._add_to_group(record)

    def compare(self, expected: Mapping[int, Sequence[Any]]) -> None:
        """Compare with the values expected from the data, by opcode."""
        for opcode, those in expected.items():
            what = Opcode(opcode).name.lower().replace("_", " ")
            if opcode in self._stored:
                stored = self._stored[opcode]
                self._compare_records(
                    what, sorted(stored) if opcode in _REPEATED else stored, those
                )
            elif those and self._stored:
                self._findings.warning("summary", f"the summary has no {what}")

    def _take_indexed(self, record: FileRecord) -> None:
        if record.opcode in _REPEATED:
            self._stored.setdefault(record.opcode, []).append(bytes(record.body))
        elif record.opcode in _PARSERS:
            self._stored.setdefault(record.opcode, []).append(self._parse_record(record))
        else:
            at = f"at byte {record.start}"
            self._findings.error("order", f"{at}, a record {record.opcode} after the data")

    def _parse_record(self, record: FileRecord) -> McapRecord:
        value: McapRecord = _PARSERS[record.opcode].read(record.stream())  # type: ignore[attr-defined]
        # The parsers are lenient: encode the result again and compare it with the bytes.
        again = RecordBuilder()
        value.write(again)
        if again.end()[FRAME.size :] != record.body:  # type: ignore[no-untyped-call]
            at = f"the record at byte {record.start}"
            self._findings.error("summary", f"{at} has wrong lengths")
        return value

    def _add_to_group(self, record: FileRecord) -> None:
        length = record.end - record.start
        if self._groups and self._groups[-1].group_opcode == record.opcode:
            self._groups[-1].group_length += length
        else:
            self._groups.append(SummaryOffset(record.opcode, record.start, length))

    def _check_footer(self, footer: Footer, record: FileRecord) -> None:
        if footer.summary_start == 0:
            self._findings.warning(
                "index", "the file has no summary: viewers must scan the whole file"
            )
            return
        if footer.summary_crc == 0:
            detail = "the summary has no checksum: damage would not be noticed"
            self._findings.warning("checksum", detail)
        begins = self._groups[0].group_start if self._groups else record.start
        if footer.summary_start != begins:
            detail = f"the footer states a wrong start of the summary, {footer.summary_start}"
            self._findings.error("summary", detail)
        if self._stored_groups and self._stored_groups != self._groups:
            self._findings.error("summary", "the summary offsets do not match the summary")

    def _compare_records(self, what: str, stored: Sequence[Any], expected: Sequence[Any]) -> None:
        if len(stored) != len(expected):
            there = f"{len(stored)} records of kind {what}, the data have {len(expected)}"
            self._findings.error("summary", f"the summary has {there}")
            return
        for number, (one, other) in enumerate(zip(stored, expected, strict=True)):
            if one != other:
                detail = f"{what} {number} does not match the data: {_name_differences(one, other)}"
                self._findings.error("summary", detail)


def _name_differences(one: Any, other: Any) -> str:
    if not is_dataclass(one):
        return "another description"
    names = [f.name for f in fields(one) if getattr(one, f.name) != getattr(other, f.name)]
    return ", ".join(f"{n} {getattr(one, n)} instead of {getattr(other, n)}" for n in names)
