"""Write a piece of a log as a log of its own; its metadata `cut` say of what.

Ticks keep their number, time and bytes. Of the other messages the piece keeps those of its ticks,
the frozen state right before them, and the gains that were set earlier.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.json_text import from_json, to_json
from pamctl.log.cutting.pieces import select_rows, split_at_gaps
from pamctl.log.framing import LogError, map_log_file
from pamctl.log.reader import Log, NoSuchColumn, read
from pamctl.log.repair.recover import LogCopy
from pamctl.log.schema import CUT, GAINS_TOPIC, KEYFRAME_TOPIC, TICK_TOPIC
from pamctl.log.writer import LogWriter
from pamctl.new_file import create_new_file, require_place
from pamctl.plain_text import escape_name

FEWEST_ROWS = 2
"""A stretch between gaps with fewer rows has no period: it is left out."""


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
    log = _read_story(source)
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
    for name, part in zip(names, kept, strict=True):
        _write_piece(log, part, name, checksum)
    return CutLog(
        str(source),
        len(t_s),
        tuple(
            LogPiece(str(n), p.start, p.stop - 1, float(t_s[p.start]), float(t_s[p.stop - 1]))
            for n, p in zip(names, kept, strict=True)
        ),
        tuple(part.start for part in parts if part not in kept),
    )


def _read_story(source: Path) -> Log:
    if source.suffix.lower() in (".csv", ".txt", ".dat", ".mat", ".tsv"):
        raise LogError(
            f"{source} is no log: import it first, `pamctl log import {source} "
            f"{source.with_suffix('.mcap').name}`, then cut that"
        )
    try:
        return read(source, fields=("tick", "t_s", "missed", "valve_v"))
    except NoSuchColumn:  # measured without a command
        return read(source, fields=("tick", "t_s", "missed"))


def _name_files(destination: Path, count: int) -> list[Path]:
    digits = len(str(count))
    return [
        destination.with_name(f"{destination.stem}-{number:0{digits}d}{destination.suffix}")
        for number in range(1, count + 1)
    ]


def _write_piece(log: Log, part: slice, destination: Path, checksum: str) -> None:
    with create_new_file(destination) as stream:
        writer = LogWriter(stream)
        copy = _PieceCopy(writer, log, part)
        copy.file(map_log_file(log.path))
        if copy.damage:
            raise LogError(f"{log.path} cannot be cut: {'; '.join(copy.damage)}")
        writer.metadata(CUT, _describe_cut(log, part, checksum))
        writer.finish()


class _PieceCopy(LogCopy):
    """Copies the messages of some ticks."""

    def __init__(self, writer: LogWriter, log: Log, part: slice) -> None:
        super().__init__(writer)
        self._rows = part
        self._row = 0
        ticks = log["tick"][part]
        self._first, self._last = int(ticks[0]), int(ticks[-1])
        self._before = self._first - 1 - int(log["missed"][part.start])

    def select_messages(self, topic: str, messages: NDArray[Any]) -> NDArray[Any]:
        """Return the messages of the piece."""
        if topic == TICK_TOPIC:
            begin, self._row = self._row, self._row + len(messages)
            there = slice(max(self._rows.start - begin, 0), max(self._rows.stop - begin, 0))
            return messages[there]
        keep = [self._belongs(topic, from_json(bytes(body))) for body in messages["body"]]
        kept: NDArray[Any] = messages[np.array(keep, dtype=bool)]
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
    before: Sequence[int] = [tick for tick in zeroed if log["tick"][0] < tick <= first_tick]
    if not before:
        return str(log.metadata.get(CUT, {}).get("homed_t_s", ""))
    return repr(float(log["t_s"][int(np.searchsorted(log["tick"], before[-1]))]))
