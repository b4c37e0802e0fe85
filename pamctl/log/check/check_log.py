"""Check a log: the MCAP file, every checksum, and whether its values are plausible.

Memory use is bounded, however long the log is. An imported log is checked in the same way, but
it needs no configuration and no outcome.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from pamctl.log.check.conformance import Conformance
from pamctl.log.check.log_problems import LogFinding, LogFindings, Severity
from pamctl.log.check.plausible import TickOrderCheck, check_columns
from pamctl.log.contents import Contents
from pamctl.log.framing import (
    Damage,
    FileRecord,
    LogError,
    map_log_file,
    translate_parse_errors,
    unpack_chunk,
    verify_checksum,
    walk_records,
)
from pamctl.log.schema import CUT, EVENT_TOPIC, TICK_TOPIC
from pamctl.log.wire import UnknownLayout

ConfigCheck = Callable[[str], Sequence[str]]
"""Returns the problems of a resolved configuration, one sentence each."""


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
    order = TickOrderCheck(findings)
    contents = Contents((EVENT_TOPIC, TICK_TOPIC), order.take)
    file = map_log_file(path)
    try:
        _check_records(file, contents, Conformance(findings), findings)
    except Damage as damage:
        if damage.offset == 0:
            raise LogError(f"{path} is not a log: {damage}") from damage
        findings.error("damage", str(damage))
    except UnknownLayout as error:
        findings.error("version", f"written by a version that cannot be read: {error}")
    if contents.ticks is None and not findings.any(Severity.ERROR):
        raise LogError(f"{path} is not a log of pamctl: it has no channel {TICK_TOPIC}")
    order.end()
    _check_story(contents, findings, problems_of_config)
    return LogCheckReport(str(path), order.count, tuple(findings.summarise()))


def _check_records(
    file: memoryview, contents: Contents, conformance: Conformance, findings: LogFindings
) -> None:
    """Take every undamaged record; raise Damage if no next record can be found."""
    for record in walk_records(file):
        try:
            with translate_parse_errors(record):
                _check_record(file, record, contents, conformance)
        except Damage as damage:
            findings.error("damage", str(damage))
            conformance.lost(record)
    if "damage" not in findings.kinds:
        conformance.end()


def _check_record(
    file: memoryview, record: FileRecord, contents: Contents, conformance: Conformance
) -> None:
    verify_checksum(file, record)
    inside = unpack_chunk(record) if record.opcode == Opcode.CHUNK else None
    conformance.take(file, record, inside)
    if inside is not None:
        contents.inside(inside)
    else:
        contents.take(file[: record.end], record)


def _check_story(
    contents: Contents, findings: LogFindings, problems_of_config: ConfigCheck
) -> None:
    """Check everything beside the ticks: columns, configuration, outcome, origin."""
    recovery = contents.metadata.get("recovery")
    check_columns(contents, findings)
    if recovery is not None:
        lost = recovery.get("lossless") == "false"
        detail = f"the log was recovered: {recovery.get('damage') or 'nothing was lost'}"
        (findings.warning if lost else findings.note)("recovered", detail)
        if lost:
            findings.soften("gap")
        if recovery.get("unverified"):
            detail = f"no checksum covers the metadata {recovery['unverified']}"
            findings.warning("unverified", detail)
    cut = contents.metadata.get(CUT)
    if cut is not None:
        where = f"rows {cut.get('first_row')} to {cut.get('last_row')}"
        findings.note("cut", f"cut from {cut.get('source')}, {where} of {cut.get('source_rows')}")
    if contents.is_imported:
        source = contents.metadata.get("import", {}).get("source", "an unknown source")
        findings.note("imported", f"imported from {source}: it has no configuration and no outcome")
        return
    _check_config(contents, findings, problems_of_config, lost=recovery is not None)
    ended = any(event.get("event") == "outcome" for event in contents.values[EVENT_TOPIC])
    if not ended and cut is None:
        findings.warning("outcome", "no outcome: the log does not say how the run ended")


def _check_config(
    contents: Contents, findings: LogFindings, problems_of_config: ConfigCheck, *, lost: bool
) -> None:
    text = contents.attachments.get("config.json")
    if text is None:
        say = findings.warning if lost else findings.error
        say("config", "no configuration is attached: the run cannot be replayed")
        return
    for problem in problems_of_config(text.decode(errors="replace")):
        findings.error("config", problem)
