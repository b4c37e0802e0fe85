"""Make a log of a part of a log, and say something of a finished one.

What is said is a metadata record behind the data. Every byte of the data stays: the end of the file
is cut off and written anew, as that of a log whose recorder died. The new file is complete before
it takes the place of the old one, so that a full disk or a power cut leaves the log as it was. A
file beside the log would be left behind when the log is copied or sent.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Metadata
from numpy.typing import NDArray

from pamctl.base.errors import ExitCode
from pamctl.base.new_file import create_new_file, require_place
from pamctl.base.texts import escape_name, to_json
from pamctl.log.framing import (
    MAGIC,
    Damage,
    LogError,
    map_log_file,
    translate_parse_errors,
)
from pamctl.log.reader import Log, read_some
from pamctl.log.record_walk import parse_messages, walk_records
from pamctl.log.recover import LogCopy, resume_log
from pamctl.log.run_meta import ANNOTATION, Annotation, date_record
from pamctl.log.schema import CUT, GAINS_TOPIC, JSON_SCHEMAS, KEYFRAME_TOPIC, TICK_TOPIC
from pamctl.log.writer import LogWriter

FEWEST_ROWS = 2
"""A stretch between gaps with fewer rows has no period: it is left out."""
GAP_PERIODS = 5.0
"""A longer time between two samples is a gap."""
HELD_S = 0.05
"""A command holds over missed ticks of this length: they only make a time step longer."""

Floats = NDArray[np.float64]


class NothingToCut(LogError):
    """The log holds nothing of the piece that was asked for. The message gives the limits."""

    exit_code = ExitCode.USAGE


@dataclass(frozen=True)
class LogPiece:
    """One file that was cut out."""

    destination: str
    first_row: int
    last_row: int
    from_s: float
    to_s: float
    """Time of the last row."""


@dataclass(frozen=True)
class CutLog:
    """The result of a cut."""

    source: str
    rows: int
    """Rows of the source."""
    pieces: tuple[LogPiece, ...]
    left_out: tuple[int, ...]
    """Rows that stand alone between two gaps."""


def find_longest_step_s(step_s: Floats, *, holds_command: bool) -> float:
    """Return the longest time between two samples that is not a gap.

    What a command does in a gap is unknown, and so is what a measured force does in it; but a
    command holds over a few missed ticks.
    """
    shortest_gap_s = GAP_PERIODS * float(np.median(step_s))
    return max(shortest_gap_s, HELD_S) if holds_command else shortest_gap_s


def split_at_gaps(t_s: Floats, *, holds_command: bool) -> tuple[slice, ...]:
    """Return the stretches between gaps, in order; times of shape (n,) without gaps are one."""
    if len(t_s) < 2:
        return (slice(0, len(t_s)),)
    step_s = np.diff(t_s)
    longest_s = find_longest_step_s(step_s, holds_command=holds_command)
    starts = (np.flatnonzero(step_s > longest_s) + 1).tolist()
    return tuple(slice(a, b) for a, b in pairwise([0, *starts, len(t_s)]))


def select_rows(
    name: str,
    t_s: Floats,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    from_row: int | None = None,
    to_row: int | None = None,
) -> slice:
    """Return the rows from `from_s` (included) to `to_s` (excluded), or of these row numbers.

    Rows count from 0. `name` is the log's, for the message. Raise NothingToCut.
    """
    start, stop = from_row or 0, len(t_s) if to_row is None else to_row
    if from_s is not None:
        start = max(start, int(np.searchsorted(t_s, from_s)))
    if to_s is not None:
        stop = min(stop, int(np.searchsorted(t_s, to_s)))
    stop = min(stop, len(t_s))
    if stop - start < 1:
        holds = (
            f"it has rows 0 to {len(t_s) - 1}, from {t_s[0]:.6g} to {t_s[-1]:.6g} s"
            if len(t_s)
            else "it has no rows"
        )
        raise NothingToCut(f"nothing of {name} lies in that piece: {holds}")
    return slice(start, stop)


def cut_log(
    source: str | Path,
    destination: str | Path,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    from_row: int | None = None,
    to_row: int | None = None,
    at_gaps: bool = False,
) -> CutLog:
    """Write a piece of a log as a new log; with `at_gaps` a file for each stretch between gaps.

    The files of `new.mcap` are then `new-1.mcap` and so on. Raise LogError if the log cannot be
    read or holds nothing of the piece, NewFileError if a file cannot be written.
    """
    source, destination = Path(source), Path(destination)
    if source.suffix.lower() in (".csv", ".txt", ".dat", ".mat", ".tsv"):
        raise LogError(
            f"{source} is no log: import it first, `pamctl log import {source} "
            f"{source.with_suffix('.mcap').name}`, then cut that"
        )
    log = read_some(source, ("tick", "t_s", "missed", "valve_v"))
    t_s = log["t_s"]
    limits = {"from_s": from_s, "to_s": to_s, "from_row": from_row, "to_row": to_row}
    whole = select_rows(str(source), t_s, **limits)  # type: ignore[arg-type]
    parts = [whole]
    if at_gaps:
        stretches = split_at_gaps(t_s[whole], holds_command="valve_v" in log.columns)
        parts = [slice(whole.start + s.start, whole.start + s.stop) for s in stretches]
    kept = [part for part in parts if part.stop - part.start >= FEWEST_ROWS or not at_gaps]
    names = _name_files(destination, len(kept)) if at_gaps else [destination]
    for name in names:
        require_place(name)
    checksum = hashlib.sha256(map_log_file(source)).hexdigest()
    pieces = []
    for name, part in zip(names, kept, strict=True):
        _write_piece(log, part, name, checksum)
        last = part.stop - 1
        piece = LogPiece(str(name), part.start, last, float(t_s[part.start]), float(t_s[last]))
        pieces.append(piece)
    left_out = tuple(part.start for part in parts if part not in kept)
    return CutLog(str(source), len(t_s), tuple(pieces), left_out)


def _name_files(destination: Path, count: int) -> list[Path]:
    digits = len(str(count))
    return [
        destination.with_name(f"{destination.stem}-{number:0{digits}d}{destination.suffix}")
        for number in range(1, count + 1)
    ]


def _write_piece(log: Log, part: slice, destination: Path, checksum: str) -> None:
    with create_new_file(destination) as stream:
        writer = LogWriter(stream)
        copy = _PieceCopy(log, part)
        copy.write(writer)
        if copy.damage:
            raise LogError(f"{log.path} cannot be cut: {'; '.join(copy.damage)}")
        writer.metadata(CUT, _describe_cut(log, part, checksum))
        writer.finish()


class _PieceCopy(LogCopy):
    """Copies the messages of some ticks."""

    def __init__(self, log: Log, part: slice) -> None:
        super().__init__(log.path)
        self.verified = True  # the log was just read
        self._rows = part
        self._times_ns = log.time_ns[part.start], log.time_ns[part.stop - 1]
        self._row = 0
        ticks = log["tick"][part]
        self._first, self._last = int(ticks[0]), int(ticks[-1])
        self._before = self._first - 1 - int(log["missed"][part.start])

    def select_messages(self, topic: str, messages: NDArray[Any]) -> NDArray[Any]:
        """Return the messages of the piece."""
        if topic == TICK_TOPIC:
            begin, self._row = self._row, self._row + len(messages)
            return messages[max(self._rows.start - begin, 0) : max(self._rows.stop - begin, 0)]
        if topic not in JSON_SCHEMAS:  # another program's
            first_ns, last_ns = self._times_ns
            times_ns = messages["log_time"]
            keep = (times_ns >= first_ns) & (times_ns <= last_ns)
        else:
            bodies = parse_messages(messages)
            keep = np.array([self._belongs(topic, body) for body in bodies], dtype=bool)
        kept: NDArray[Any] = messages[keep]
        return kept

    def _belongs(self, topic: str, message: Any) -> bool:
        tick = int(message.get("tick", self._first))
        if topic == GAINS_TOPIC:  # the gains at the start are those that were set last
            return tick <= self._last
        state_before = topic == KEYFRAME_TOPIC and tick == self._before
        return self._first <= tick <= self._last or state_before


def _describe_cut(log: Log, part: slice, checksum: str) -> dict[str, str]:
    t_s, ticks = log["t_s"], log["tick"]
    story = {
        "source": escape_name(log.path.name),
        "sha256": checksum,
        "source_rows": str(len(t_s)),
        "first_row": str(part.start),
        "last_row": str(part.stop - 1),
        "from_s": repr(float(t_s[part.start])),
        "to_s": repr(float(t_s[part.stop - 1])),
        "homed_t_s": _find_homing(log, int(ticks[part.start])),
        "has_orders": str(any(e.get("event") == "order" for e in log.events)).lower(),
    }
    earlier = log.metadata.get(CUT)
    return {**story, "source_cut": to_json(earlier).decode()} if earlier else story


def _find_homing(log: Log, first_tick: int) -> str:
    """Return the time from which the program of the run counts; empty where it is not known.

    It is that of the last zeros before the piece.
    """
    zeroed = [e["tick"] for e in log.events if e.get("event") == "zeroed"]
    before = [tick for tick in zeroed if log["tick"][0] < tick <= first_tick]
    if not before:
        return str(log.metadata.get(CUT, {}).get("homed_t_s", ""))
    return repr(float(log["t_s"][int(np.searchsorted(log["tick"], before[-1]))]))


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
    """Add a metadata record to a finished log; raise LogError where that is damaged."""
    path = Path(os.path.realpath(path))
    before = path.stat()
    try:
        with create_new_file(path, replaces="") as stream:
            with path.open("rb") as log:
                shutil.copyfileobj(log, stream, _BLOCK_BYTES)
            shutil.copymode(path, stream.name)
            with suppress(OSError, AttributeError):  # only root can; Windows has no such owners
                os.chown(stream.name, before.st_uid, before.st_gid)
            resumed = resume_log(path, stream)
            if resumed.damage or map_log_file(path)[-len(MAGIC) :] != MAGIC:
                raise Damage(before.st_size, "its end is missing")
            resumed.writer.metadata(name, values)
            resumed.writer.finish()
            if path.stat().st_size != before.st_size:
                raise LogError(f"{path} has changed meanwhile; try again")
    except Damage as damage:
        fix = f"save the undamaged part with `pamctl log recover {path} DESTINATION`"
        raise LogError(f"{path} is damaged, or not finished: {damage}; {fix}") from damage
    with suppress(OSError):  # the time of the measurement, for those who sort by it
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
