"""Ticks by log and number: from memory while they are there, else from the log's file."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.live.scope.tick_memory import TickMemory
from pamctl.live.scope.trigger import Armed, Crossing, Slope, find_crossing
from pamctl.log.edit import cut_log
from pamctl.log.framing import LogError
from pamctl.log.reader import read
from pamctl.plain_text import clean_document

MOST_VALUES = 20_000_000
"""In one answer, 160 MB: two minutes of fourteen columns at 10 kHz are 17 million."""


class ScopeRefusal(Exception):
    """A question that cannot be answered, with the status of its answer."""

    def __init__(self, status: HTTPStatus, message: str) -> None:
        """`message` is for people."""
        super().__init__(message)
        self.status = status


class TickRange(NamedTuple):
    """Ticks of one log, from the first to the last, both included."""

    log: str
    first_tick: int
    last_tick: int


class Search(NamedTuple):
    """The result of a search for a trigger."""

    tick: int | None
    """The tick of the crossing; None if there is none yet."""
    t_s: float | None
    searched: int
    """The last tick that was looked at: the next search begins behind it."""
    armed: Armed


class TickSource:
    """Hands out ticks of the current run and of every log in the daemon's folder."""

    def __init__(self, memory: TickMemory) -> None:
        """Ask `memory` first."""
        self._memory = memory
        self.folder: Path | None = None
        """The daemon's logs; None before the daemon has answered."""

    def read_columns(
        self, stretch: TickRange, names: Sequence[str], every: int = 1
    ) -> Mapping[str, NDArray[np.float64]]:
        """Return columns of every `every`th tick of a stretch. Raises `ScopeRefusal`."""
        columns = self._read_all(stretch, names, every)
        if sum(map(len, columns.values())) > MOST_VALUES:
            raise ScopeRefusal(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"more than {MOST_VALUES} values: choose a shorter time or fewer fields",
            )
        return columns

    def _read_all(
        self, stretch: TickRange, names: Sequence[str], every: int
    ) -> Mapping[str, NDArray[np.float64]]:
        held = self._memory.state()
        is_held = held.is_complete or held.first_tick <= stretch.first_tick
        if stretch.log == held.log and is_held:
            try:
                return self._memory.read_columns(
                    names, stretch.first_tick, stretch.last_tick, every
                )
            except KeyError as error:
                raise ScopeRefusal(HTTPStatus.BAD_REQUEST, f"no field {error.args[0]}") from None
        return self._read_file(stretch, names, every)

    def _read_file(
        self, stretch: TickRange, names: Sequence[str], every: int
    ) -> Mapping[str, NDArray[np.float64]]:
        try:
            log = read(self._require_log(stretch.log), fields=dict.fromkeys(["tick", *names]))
            start = np.searchsorted(log["tick"], stretch.first_tick, "left")
            part = slice(start, np.searchsorted(log["tick"], stretch.last_tick, "right"), every)
            return {name: log[name][part].astype(np.float64) for name in names}
        except (LogError, OSError) as error:
            raise ScopeRefusal(HTTPStatus.CONFLICT, str(error)) from None

    def read_events(self, log: str) -> list[dict[str, Any]]:
        """Return the events of a log, oldest first, each with its `tick`. Raises `ScopeRefusal`."""
        if self._memory.state().log == log:
            return self._memory.events()
        try:
            events = read(self._require_log(log), fields=("tick",)).events
        except (LogError, OSError) as error:
            raise ScopeRefusal(HTTPStatus.CONFLICT, str(error)) from None
        return [clean_document(event) for event in events]

    def search(
        self,
        log: str,
        field: str,
        after_tick: int,
        level: float,
        slope: Slope,
        hysteresis: float = 0.0,
        armed: Armed | None = None,
    ) -> Search:
        """Search the ticks behind `after_tick` for the first crossing. Raises `ScopeRefusal`."""
        stretch = TickRange(log, after_tick + 1, 1 << 62)
        columns = self.read_columns(stretch, ("tick", "t_s", field))
        crossing: Crossing = find_crossing(columns[field], level, slope, hysteresis, armed)
        ticks, at = columns["tick"], crossing.at
        searched = int(ticks[-1]) if len(ticks) else after_tick
        if at is None:
            return Search(None, None, searched, crossing.armed)
        return Search(int(ticks[at]), float(columns["t_s"][at]), searched, crossing.armed)

    def cut(self, stretch: TickRange) -> bytes:
        """Return a stretch of a finished log as a log of its own. Raises `ScopeRefusal`."""
        source = self._require_log(stretch.log)
        if self._memory.is_following(stretch.log):
            raise ScopeRefusal(
                HTTPStatus.CONFLICT, "the run goes on: its log can be cut when it is over"
            )
        try:
            ticks = read(source, fields=("tick",))["tick"]
            first = int(np.searchsorted(ticks, stretch.first_tick, "left"))
            end = int(np.searchsorted(ticks, stretch.last_tick, "right"))
            with tempfile.TemporaryDirectory() as place:
                piece = Path(place) / "cut.mcap"
                cut_log(source, piece, from_row=first, to_row=end)
                return piece.read_bytes()
        except (LogError, OSError) as error:
            raise ScopeRefusal(HTTPStatus.CONFLICT, str(error)) from None

    def _find_log(self, name: str) -> Path:
        """Return the path of a log of the daemon's folder; names with a folder are refused."""
        if self.folder is None or Path(name).name != name or not name.endswith(".mcap"):
            raise ScopeRefusal(HTTPStatus.NOT_FOUND, "there is no such log")
        return self.folder / name

    def _require_log(self, name: str) -> Path:
        path = self._find_log(name)
        if not path.is_file():
            raise ScopeRefusal(
                HTTPStatus.NOT_FOUND, "there is no such log yet: it is whole when the run is over"
            )
        return path
