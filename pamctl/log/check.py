"""Check a log: read all of it strictly, and compare it with its index, its clock and its story.

Memory use is bounded, however long the log is. An imported log is checked in the same way, but
it needs no configuration and no outcome. https://mcap.dev/spec
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from pamctl.json_text import from_json
from pamctl.log.framing import (
    NO_CHECKSUM,
    Damage,
    FileRecord,
    LogError,
    Unpacker,
    encode_record,
    record_at,
    translate_parse_errors,
    verify_checksum,
    walk_records,
)
from pamctl.log.measured_signals import (
    describe_unknown_phase,
    find_signal_problems,
    find_unknown_phase,
)
from pamctl.log.reader import Scan
from pamctl.log.record_problems import RecordProblem
from pamctl.log.schema import (
    CUT,
    EVENT_TOPIC,
    IMPORTED_QUANTITIES,
    SCHEMA_VERSION,
    TICK_TOPIC,
    unit_of_column,
)
from pamctl.log.wire import (
    SEQUENCE,
    MessageRun,
    TickBatch,
    UnknownLayout,
    find_message_run,
    walk_messages,
)
from pamctl.log.writer import INDEX_ENTRY, FileIndex
from pamctl.signals import TICK_FIELDS

MOST_OF_A_KIND = 5
"""Findings of one kind that are listed one by one; the rest is only counted."""
CLOCK_TOLERANCE_S = 1e-6
"""Two clocks of one log differ by rounding: nanoseconds, and doubles over hours."""

ConfigCheck = Callable[[str], Sequence[str]]
"""Returns the problems of a resolved configuration, one sentence each."""


class Severity(StrEnum):
    """The severity of a finding."""

    ERROR = "error"
    """The file is wrong, or holds impossible values."""
    WARNING = "warning"
    """A user of the file should know this, but the file is usable."""
    NOTE = "note"
    """Nothing is wrong, but it is worth mentioning."""


class LogFinding(NamedTuple):
    """One finding."""

    severity: Severity
    kind: str
    """A name that stays the same between versions, for scripts."""
    message: str


@dataclass
class LogFindings:
    """All findings, in the order in which they were made."""

    all: list[LogFinding] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)
    """Number of findings of each kind, listed or not."""

    def error(self, kind: str, message: str) -> None:
        """Add an error."""
        self.add(Severity.ERROR, kind, message)

    def warning(self, kind: str, message: str) -> None:
        """Add a warning."""
        self.add(Severity.WARNING, kind, message)

    def note(self, kind: str, message: str) -> None:
        """Add a note."""
        self.add(Severity.NOTE, kind, message)

    def add(self, severity: Severity, kind: str, message: str) -> None:
        """Add a finding."""
        self.kinds[kind] += 1
        if self.kinds[kind] <= MOST_OF_A_KIND:
            self.all.append(LogFinding(severity, kind, message))

    def errors(self, kind: str, rows: NDArray[np.intp], describe: Callable[[int], str]) -> None:
        """Add an error for each of these rows; only those that are listed are described."""
        for row in rows[:MOST_OF_A_KIND].tolist():
            self.error(kind, describe(row))
        self.kinds[kind] += len(rows[MOST_OF_A_KIND:])
        if not self.kinds[kind]:
            del self.kinds[kind]

    def summarise(self) -> list[LogFinding]:
        """Return the findings, and for each kind with too many the number of the rest."""
        more = {kind: n - MOST_OF_A_KIND for kind, n in self.kinds.items() if n > MOST_OF_A_KIND}
        weights = {finding.kind: finding.severity for finding in self.all}
        rest = (
            LogFinding(weights[kind], kind, f"and {n} more of these") for kind, n in more.items()
        )
        return [*self.all, *rest]

    def any(self, severity: Severity) -> bool:
        """Tell whether there is a finding of this severity."""
        return any(finding.severity == severity for finding in self.all)

    def soften(self, kind: str) -> None:
        """Turn errors of a kind into warnings: something else explains them."""
        self.all = [
            finding._replace(severity=Severity.WARNING) if finding.kind == kind else finding
            for finding in self.all
        ]


@dataclass(frozen=True)
class LogCheckReport:
    """The findings in one log."""

    path: str
    ticks: int
    findings: tuple[LogFinding, ...]

    @property
    def ok(self) -> bool:
        """Whether there are no errors."""
        return all(finding.severity != Severity.ERROR for finding in self.findings)


def check_log(
    path: str | Path, problems_of_config: ConfigCheck = lambda text: ()
) -> LogCheckReport:
    """Check a log; raise LogError if the file is not a log at all."""
    path = Path(path)
    findings = LogFindings()
    ticks = _TickCheck(findings)
    scan = Scan(path, (EVENT_TOPIC, TICK_TOPIC), take=ticks.take)
    try:
        _check_records(scan, findings)
    except Damage as damage:
        if damage.offset == 0:
            raise LogError(f"{path} is not a log: {damage}") from damage
        findings.error("damage", str(damage))
    except UnknownLayout as error:
        findings.error("version", f"written by a version that cannot be read: {error}")
    if scan.ticks is None and not findings.any(Severity.ERROR):
        raise LogError(f"{path} is not a log of pamctl: it has no channel {TICK_TOPIC}")
    ticks.end()
    _check_schema(scan, findings)
    _check_story(scan, findings, problems_of_config)
    return LogCheckReport(str(path), ticks.count, tuple(findings.summarise()))


def _check_records(scan: Scan, findings: LogFindings) -> None:
    """Take every undamaged record; raise Damage if no next record can be found."""
    file = _FileCheck(scan.file, findings)
    unpacker = Unpacker(scan.path, scan.file)
    try:
        for record in walk_records(scan.file):
            try:
                with translate_parse_errors(record):
                    verify_checksum(scan.file, record)
                    if record.opcode == Opcode.CHUNK:
                        chunk, content = unpacker.unpack(record)
                        parts = list(walk_messages(content))
                        file.take_chunk(record, chunk, len(content), parts)
                        scan.take_parts(parts, record.start)
                    else:
                        file.take(record)
                        scan.take(record)
            except Damage as damage:
                findings.error("damage", str(damage))
                file.pass_over(record)
    finally:
        scan.flush()
    if "damage" not in findings.kinds:
        file.end()


_REPEATED = (Opcode.SCHEMA, Opcode.CHANNEL)
_SUMMARY: Mapping[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.STATISTICS: Statistics,
}


class _FileCheck:
    """Follows the records of a file, builds the index they should have, and compares it."""

    def __init__(self, data: memoryview, findings: LogFindings) -> None:
        self._data, self._findings = data, findings
        self._index = FileIndex(findings.error)
        self._expected: Mapping[int, NDArray[Any]] = {}
        """The message index of the last chunk, by channel."""
        self._last = 0
        self._summary: list[FileRecord] = []
        self._in_summary = False

    def take(self, record: FileRecord) -> None:
        """Take the next record that is no chunk."""
        is_first, self._last, before = self._last == 0, record.opcode, self._last
        if is_first and record.opcode != Opcode.HEADER:
            begin = f"a record {record.opcode} instead of its header"
            self._findings.error("order", f"the file begins with {begin}")
        if self._in_summary:
            self._take_of_summary(record)
            return
        match record.opcode:
            case Opcode.MESSAGE_INDEX:
                self._check_message_index(record, before)
            case Opcode.MESSAGE:
                self._index.take_messages(find_message_run(self._data[: record.end], record))
            case Opcode.SCHEMA | Opcode.CHANNEL | Opcode.METADATA:
                self._index.take(record)
            case Opcode.ATTACHMENT:
                self._index.take(record)
                if record.body[-4:] == NO_CHECKSUM:
                    self._warn_unchecked(f"the attachment {self._index.attachments[-1].name}")
            case Opcode.DATA_END:
                self._in_summary = True
                if DataEnd.read(record.stream()).data_section_crc == 0:
                    self._warn_unchecked("the data section")
            case Opcode.HEADER if is_first:
                pass
            case _:
                where = f"at byte {record.start}, a record {record.opcode}"
                self._findings.error("order", f"{where} among the data")

    def pass_over(self, record: FileRecord) -> None:
        """Take a damaged record: its content is unknown, and is not reported as missing."""
        self._last = record.opcode
        self._in_summary = self._in_summary or record.opcode == Opcode.DATA_END

    def take_chunk(
        self, record: FileRecord, chunk: Chunk, size: int, parts: Sequence[FileRecord | MessageRun]
    ) -> None:
        """Take a chunk of `size` bytes that holds these parts."""
        self._last = record.opcode
        for part in parts:
            if isinstance(part, FileRecord) and part.opcode not in _REPEATED:
                raise Damage(record.start, f"a chunk holds a record {part.opcode}")
        times, self._expected = self._index.take_chunk(parts)
        where = f"the chunk at byte {record.start}"
        if (chunk.message_start_time, chunk.message_end_time) != times:
            what = "states times that differ from those of its messages"
            self._findings.error("chunk", f"{where} {what}")
        if chunk.uncompressed_size != size:
            what = f"states that it holds {chunk.uncompressed_size} bytes, not {size}"
            self._findings.error("chunk", f"{where} {what}")
        if chunk.uncompressed_crc == 0:
            self._warn_unchecked(where)
        self._index.add_chunk(chunk, record.start, record.end - record.start)

    def end(self) -> None:
        """Compare the summary with the data. Call it only if the file is not damaged."""
        stored: dict[int, list[bytes]] = {}
        for record in self._summary:
            stored.setdefault(record.opcode, []).append(record.frame())
        for opcode, expected in self._index.groups().items():
            what = Opcode(opcode).name.lower().replace("_", " ")
            if opcode in stored:
                self._compare(opcode, what, stored[opcode], expected)
            elif expected and stored:
                self._findings.warning("summary", f"the summary has no {what}")

    def _check_message_index(self, record: FileRecord, before: int) -> None:
        channel = int.from_bytes(record.body[:2], "little")
        if before not in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            where = f"at byte {record.start}, a message index"
            self._findings.error("order", f"{where} does not follow a chunk")
        stored = np.frombuffer(record.body[6:], INDEX_ENTRY)
        expected = self._expected.get(channel, stored[:0])
        is_equal = record.body[6:] == expected.tobytes() or np.array_equal(
            np.sort(stored), np.sort(expected)
        )
        if not is_equal or int.from_bytes(record.body[2:6], "little") != stored.nbytes:
            what = f"the message index of channel {channel} at byte {record.start}"
            self._findings.error("index", f"{what} does not match its chunk")
        if self._index.chunks:
            self._index.add_message_index(channel, record.start, record.end - record.start)

    def _take_of_summary(self, record: FileRecord) -> None:
        if record.opcode == Opcode.FOOTER:
            self._check_footer(Footer.read(record.stream()), record)
        elif record.opcode in _SUMMARY:
            _SUMMARY[record.opcode].read(record.stream())  # raises where it makes no sense
            self._summary.append(record)
        else:
            where = f"at byte {record.start}, a record {record.opcode}"
            self._findings.error("order", f"{where} after the data")

    def _check_footer(self, footer: Footer, record: FileRecord) -> None:
        if footer.summary_start == 0:
            detail = "the file has no summary: viewers must scan the whole file"
            self._findings.warning("index", detail)
            return
        if footer.summary_crc == 0:
            self._warn_unchecked("the summary")
        groups: dict[int, SummaryOffset] = {}
        offsets: list[SummaryOffset] = []
        for one in self._summary:
            if one.opcode == Opcode.SUMMARY_OFFSET:
                offsets.append(SummaryOffset.read(one.stream()))
            else:
                group = groups.setdefault(one.opcode, SummaryOffset(one.opcode, one.start, 0))
                group.group_length += one.end - one.start
        begins = self._summary[0].start if groups else record.start
        if footer.summary_start != begins:
            detail = f"the footer states a wrong start of the summary, {footer.summary_start}"
            self._findings.error("summary", detail)
        named = [offset for offset in offsets if offset.group_length]
        if named and named != list(groups.values()):
            self._findings.error("summary", "the summary offsets do not match the summary")

    def _compare(
        self, opcode: int, what: str, stored: Sequence[bytes], expected: Sequence[bytes]
    ) -> None:
        if len(stored) != len(expected):
            there = f"{len(stored)} records of kind {what}, the data have {len(expected)}"
            self._findings.error("summary", f"the summary has {there}")
            return
        if opcode in _REPEATED:
            stored, expected = sorted(stored), sorted(expected)
        for number, (one, other) in enumerate(zip(stored, expected, strict=True)):
            if one != other and (wrong := _describe_difference(opcode, one, other)):
                detail = f"{what} {number} does not match the data: {wrong}"
                self._findings.error("summary", detail)

    def _warn_unchecked(self, what: str) -> None:
        self._findings.warning("checksum", f"{what} has no checksum: damage would not be noticed")


def _describe_difference(opcode: int, one: bytes, other: bytes) -> str:
    """Say in what a record differs from the one that was expected; empty: only in its order."""
    if opcode in _REPEATED:
        return "another description"
    stored, expected = (_parse_summary(opcode, frame) for frame in (one, other))
    wrong = [
        f"{part.name} {getattr(stored, part.name)} instead of {getattr(expected, part.name)}"
        for part in fields(stored)
        if getattr(stored, part.name) != getattr(expected, part.name)
    ]
    # The parsers are lenient: encode the result again and compare it with the bytes.
    return ", ".join(wrong) or ("" if encode_record(stored) == one else "it has wrong lengths")


def _parse_summary(opcode: int, frame: bytes) -> McapRecord:
    record: McapRecord = _SUMMARY[opcode].read(record_at(memoryview(frame), 0).stream())
    return record


_FIRST_TICKS = 100
"""Ticks whose median step is taken as the period."""
_NEEDED = ("tick", "t_s", "dt_s", "missed")
_NUMBER_OFF = 100.0
"""Ticks by which number and time may differ: a card's clock is not the computer's."""


class _TickCheck:
    """Follows the ticks batch by batch, and reports where number or time is not continuous."""

    def __init__(self, findings: LogFindings) -> None:
        self._findings = findings
        self._before: dict[str, NDArray[Any]] = {}
        self._period_s = float("nan")
        self._signals = _SignalCheck()
        self.count = self.missed = self.gaps = 0

    def take(self, batch: TickBatch) -> None:
        """Take the next ticks."""
        first, self.count = self.count, self.count + len(batch.sequence)
        if not all(name in batch.columns for name in _NEEDED):
            return
        self._signals.take(batch)
        now = {name: np.asarray(batch.columns[name]) for name in _NEEDED}
        now["time_ns"] = batch.log_time_ns.astype(np.int64)
        if first == 0:
            self._check_first(now)
        ticks = {
            name: np.concatenate([self._before.get(name, column[:0]), column])
            for name, column in now.items()
        }
        self._check_numbers(ticks)
        self._check_times(ticks)
        self._check_phases(now["tick"], batch)
        self._before = {name: column[-1:].copy() for name, column in now.items()}

    def end(self) -> None:
        """Report what all ticks together show."""
        for problem in self._signals.find_problems():
            self._findings.add(_weigh(problem), problem.kind, problem.describe())
        if self.missed:
            counted = f"{self.missed} ticks in {self.gaps} gaps were missed; the log counts them"
            self._findings.note("missed", counted)

    def _check_first(self, now: Mapping[str, NDArray[Any]]) -> None:
        """Check that the number of the first tick is right, whatever was cut off before it."""
        self._period_s = float(np.median(now["dt_s"][:_FIRST_TICKS]))
        tick, t_s = int(now["tick"][0]), float(now["t_s"][0])
        by_time = t_s / self._period_s if self._period_s > 0.0 else np.nan
        if abs(tick - by_time) > _NUMBER_OFF + 0.05 * abs(by_time):
            where = f"the first tick has the number {tick} at {t_s:g} s"
            self._findings.error("tick-order", f"{where}: by its time it is tick {by_time:.0f}")

    def _check_numbers(self, ticks: Mapping[str, NDArray[Any]]) -> None:
        tick = ticks["tick"]
        step, missed = np.diff(tick), ticks["missed"][1:]
        self.missed += int(missed.sum())
        self.gaps += int(np.count_nonzero(missed))
        self._findings.errors(
            "tick-order",
            np.flatnonzero(step <= 0),
            lambda i: f"tick {tick[i + 1]} follows tick {tick[i]}",
        )
        self._findings.errors(
            "gap",
            np.flatnonzero((step > 0) & (step - 1 != missed)),
            lambda i: (
                f"{step[i] - 1} ticks are missing between {tick[i]} and {tick[i + 1]}, "
                f"but the loop missed {missed[i]}"
            ),
        )

    @np.errstate(invalid="ignore")  # a time may be infinite
    def _check_times(self, ticks: Mapping[str, NDArray[Any]]) -> None:
        tick, dt_s, missed = ticks["tick"], ticks["dt_s"][1:], ticks["missed"][1:]
        step = np.diff(ticks["t_s"])
        wall = np.diff(ticks["time_ns"]) * 1e-9
        # After an uncounted gap, the time since the last tick in the file means nothing.
        whole = (np.diff(tick) - 1 == missed) & (step > 0)
        self._findings.errors(
            "clock",
            np.flatnonzero(whole & ~(np.abs(dt_s - step) <= CLOCK_TOLERANCE_S)),
            lambda i: f"at tick {tick[i + 1]}, dt_s is {dt_s[i]}, but t_s advanced by {step[i]}",
        )
        self._findings.errors(
            "clock",
            np.flatnonzero(~(np.abs(wall - step) <= CLOCK_TOLERANCE_S)),
            lambda i: (
                f"at tick {tick[i + 1]}, log_time advanced by {wall[i]} s, but t_s by {step[i]}"
            ),
        )
        periods = dt_s / self._period_s - (1 + missed)
        for i in np.flatnonzero(whole & ~(np.abs(periods) <= 1.0)).tolist():
            detail = f"dt_s is {dt_s[i]}, with {missed[i]} missed ticks"
            self._findings.warning("period", f"at tick {tick[i + 1]}, {detail}")

    def _check_phases(self, tick: NDArray[Any], batch: TickBatch) -> None:
        differs = tick & SEQUENCE != batch.sequence
        if differs.any():
            at = int(tick[differs.argmax()])
            detail = f"tick {at} differs from the sequence number of its message"
            self._findings.error("sequence", detail)
        phase = batch.columns.get("phase", np.empty(0, np.int64))
        unknown = find_unknown_phase(phase)
        if unknown is not None and "phase" not in self._findings.kinds:
            at = int(tick[(phase == unknown).argmax()])
            self._findings.error("phase", f"from tick {at} on, {describe_unknown_phase(unknown)}")


_PIECE_TICKS = 1 << 17
"""Ticks whose signals are looked at together: two minutes at 1 kHz."""
_OF_THE_WHOLE = ("constant", "reversed")
"""Kinds that mean nothing where they are not true of each piece."""


class _SignalCheck:
    """Looks at the measured signals, piece by piece."""

    def __init__(self) -> None:
        self._parts: list[dict[str, NDArray[Any]]] = []
        self._pieces = self._rows = self._first_row = 0
        self._found: dict[tuple[str, str], list[RecordProblem]] = {}

    def take(self, batch: TickBatch) -> None:
        """Take the next ticks."""
        kept = [name for name in ("t_s", *IMPORTED_QUANTITIES) if name in batch.columns]
        self._parts.append({name: np.array(batch.columns[name], np.float64) for name in kept})
        self._rows += len(batch.log_time_ns)
        if self._rows - self._first_row > _PIECE_TICKS:
            self._judge()

    def _judge(self) -> None:
        """Judge the ticks that were taken; the last one begins the next piece, too."""
        piece = {n: np.concatenate([part[n] for part in self._parts]) for n in self._parts[0]}
        for problem in find_signal_problems(piece):
            moved = tuple((a + self._first_row, b + self._first_row) for a, b in problem.stretches)
            found = self._found.setdefault((problem.kind, problem.column), [])
            found.append(problem._replace(stretches=moved, share=problem.share * len(piece["t_s"])))
        self._pieces += 1
        self._first_row = self._rows - 1
        self._parts = [{name: column[-1:] for name, column in piece.items()}]

    def find_problems(self) -> list[RecordProblem]:
        """Return the problems of all ticks, each kind of a column once."""
        if not self._rows:
            return find_signal_problems({"t_s": np.empty(0)})
        if self._rows - self._first_row > 1 or not self._pieces:
            self._judge()
        return [
            found[0]._replace(
                stretches=tuple(stretch for one in found for stretch in one.stretches),
                to_s=found[-1].to_s,
                share=sum(one.share for one in found) / self._rows,
            )
            for (kind, _), found in self._found.items()
            if len(found) == self._pieces or kind not in _OF_THE_WHOLE
        ]


def _weigh(problem: RecordProblem) -> Severity:
    if problem.kind == "constant":  # a rig at rest
        return Severity.NOTE
    is_wrong = problem.is_fatal and problem.kind != "short"  # a run may end before its first tick
    return Severity.ERROR if is_wrong else Severity.WARNING


def _check_schema(scan: Scan, findings: LogFindings) -> None:
    """Check that the ticks have the expected columns, each with its unit."""
    if scan.ticks is None:
        return
    channel = scan.channels[scan.tick_channel]
    label = scan.schemas[channel.schema_id].encoding
    if label != "protobuf":
        detail = f"the schema of {TICK_TOPIC} is protobuf, but is labelled {label!r}"
        findings.error("schema", f"{detail}: other tools will not read the ticks")
    written = channel.metadata.get("schema_version", "")
    version = int(written) if written.isdecimal() else 0
    try:
        stated = dict(from_json(channel.metadata.get("units", "{}")))
    except (ValueError, TypeError) as error:
        findings.error("units", f"the metadata of {TICK_TOPIC} makes no sense: {error}")
        return
    for name, column in scan.ticks.none.items():
        unit = unit_of_column(name)
        if column.dtype.kind == "f" and unit == "1":
            findings.error("units", f"the name of {name} states no unit")
        elif stated.get(name) != unit:
            findings.error(
                "units", f"{name} is stated in {stated.get(name)}, but its name says {unit}"
            )
    if version < 1:
        detail = f"the schema version of {TICK_TOPIC} is {written!r}; versions begin with 1"
        findings.error("version", detail)
    if version > SCHEMA_VERSION:
        findings.warning("version", f"schema {version} is newer than this pamctl's")
    known = [field.name for field in TICK_FIELDS] if version == SCHEMA_VERSION else _NEEDED
    for name in _NEEDED if scan.is_imported else known:
        if name not in scan.ticks.none:
            findings.error("columns", f"there is no column {name}")


def _check_story(scan: Scan, findings: LogFindings, problems_of_config: ConfigCheck) -> None:
    """Check everything beside the ticks: repair, origin, configuration, outcome."""
    recovery = scan.metadata.get("recovery")
    if recovery is not None:
        lost = recovery.get("lossless") == "false"
        detail = f"the log was recovered: {recovery.get('damage') or 'nothing was lost'}"
        (findings.warning if lost else findings.note)("recovered", detail)
        if lost:
            findings.soften("gap")
        if recovery.get("unverified"):
            detail = f"no checksum covers the metadata {recovery['unverified']}"
            findings.warning("unverified", detail)
    cut = scan.metadata.get(CUT)
    if cut is not None:
        where = f"rows {cut.get('first_row')} to {cut.get('last_row')}"
        findings.note("cut", f"cut from {cut.get('source')}, {where} of {cut.get('source_rows')}")
    if scan.is_imported:
        source = scan.metadata.get("import", {}).get("source", "an unknown source")
        findings.note("imported", f"imported from {source}: it has no configuration and no outcome")
        return
    text = scan.attachments.get("config.json")
    if text is None:
        say = findings.warning if recovery is not None else findings.error
        say("config", "no configuration is attached: the run cannot be replayed")
    else:
        for problem in problems_of_config(text.decode(errors="replace")):
            findings.error("config", problem)
    if scan.outcome is None and cut is None:
        findings.warning("outcome", "no outcome: the log does not say how the run ended")
