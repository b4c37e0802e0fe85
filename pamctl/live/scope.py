"""The scope of the page: ticks by log and number, and searches for a trigger in them.

    /scope/state                              what is held, and the events of the run
    /scope/trigger?log=&field=&level=&slope=&hysteresis=&after=&armed=
    /scope/ticks?log=&first=&last=&every=&fields=a,b     columns of little-endian doubles
    /scope/cut?log=&first=&last=              a log of its own
    /scope/events?log=                        marks, trips and other events, each with its tick

Ticks come from memory while they are there, else from the log's file.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pamctl.live.page_orders import PageRefusal
from pamctl.live.tick_memory import TickMemory
from pamctl.log.edit import cut_log
from pamctl.log.framing import LogError
from pamctl.log.reader import read
from pamctl.plain_text import clean_document

Slope = Literal["rising", "falling", "either"]


class Armed(NamedTuple):
    """Whether the signal was on the near side of the level, beyond the hysteresis."""

    rising: bool = False
    falling: bool = False


class Crossing(NamedTuple):
    """The result of a search."""

    at: int | None
    """Index of the first value at or beyond the level; None if there is none."""
    armed: Armed
    """For the search in the values that follow."""


def find_crossing(
    values: NDArray[np.float64],
    level: float,
    slope: Slope,
    hysteresis: float = 0.0,
    armed: Armed | None = None,
) -> Crossing:
    """Find the first crossing of `level` in `values` of shape (n,).

    A rising crossing is the first value at or above the level, after one that was below it by
    more than `hysteresis`; a falling one is its mirror image. NaN neither arms nor crosses. A
    search in pieces, each with the `armed` of the one before, finds what a search in one finds.
    """
    before = armed or Armed()
    rising, is_rising_armed = _find_rise(values, level, hysteresis, before.rising)
    falling, is_falling_armed = _find_rise(-values, -level, hysteresis, before.falling)
    found = {"rising": [rising], "falling": [falling], "either": [rising, falling]}[slope]
    index = min((at for at in found if at is not None), default=None)
    return Crossing(index, Armed(is_rising_armed, is_falling_armed))


def _find_rise(
    values: NDArray[np.float64], level: float, hysteresis: float, armed: bool
) -> tuple[int | None, bool]:
    start = 0
    if not armed:
        below = np.flatnonzero(values < level - hysteresis)
        if not len(below):
            return None, False
        start = int(below[0])
    above = np.flatnonzero(values[start:] >= level)
    return (start + int(above[0]), False) if len(above) else (None, True)


MOST_VALUES = 20_000_000
"""In one answer, 160 MB: two minutes of fourteen columns at 10 kHz are 17 million."""


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
        """Return columns of every `every`th tick of a stretch. Raises `PageRefusal`."""
        columns = self._read_all(stretch, names, every)
        if sum(map(len, columns.values())) > MOST_VALUES:
            raise PageRefusal(
                f"more than {MOST_VALUES} values: choose a shorter time or fewer fields",
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
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
                raise PageRefusal(f"no field {error.args[0]}") from None
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
            raise PageRefusal(str(error), HTTPStatus.CONFLICT) from None

    def read_events(self, log: str) -> list[dict[str, Any]]:
        """Return the events of a log, oldest first, each with its `tick`. Raises `PageRefusal`."""
        if self._memory.state().log == log:
            return self._memory.events()
        try:
            events = read(self._require_log(log), fields=("tick",)).events
        except (LogError, OSError) as error:
            raise PageRefusal(str(error), HTTPStatus.CONFLICT) from None
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
        """Search the ticks behind `after_tick` for the first crossing. Raises `PageRefusal`."""
        stretch = TickRange(log, after_tick + 1, 1 << 62)
        columns = self.read_columns(stretch, ("tick", "t_s", field))
        crossing: Crossing = find_crossing(columns[field], level, slope, hysteresis, armed)
        ticks, at = columns["tick"], crossing.at
        searched = int(ticks[-1]) if len(ticks) else after_tick
        if at is None:
            return Search(None, None, searched, crossing.armed)
        return Search(int(ticks[at]), float(columns["t_s"][at]), searched, crossing.armed)

    def cut(self, stretch: TickRange) -> bytes:
        """Return a stretch of a finished log as a log of its own. Raises `PageRefusal`."""
        source = self._require_log(stretch.log)
        if self._memory.is_following(stretch.log):
            raise PageRefusal(
                "the run goes on: its log can be cut when it is over", HTTPStatus.CONFLICT
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
            raise PageRefusal(str(error), HTTPStatus.CONFLICT) from None

    def _find_log(self, name: str) -> Path:
        """Return the path of a log of the daemon's folder; names with a folder are refused."""
        if self.folder is None or Path(name).name != name or not name.endswith(".mcap"):
            raise PageRefusal("there is no such log", HTTPStatus.NOT_FOUND)
        return self.folder / name

    def _require_log(self, name: str) -> Path:
        path = self._find_log(name)
        if not path.is_file():
            raise PageRefusal(
                "there is no such log yet: it is whole when the run is over", HTTPStatus.NOT_FOUND
            )
        return path


_JSON, _BINARY = "application/json", "application/octet-stream"
_LAST_TICK = (1 << 53) - 1
"""The largest number that a browser holds exactly."""

Tick = Annotated[int, Field(ge=-1, le=_LAST_TICK)]
LogName = Annotated[str, Field(min_length=1, max_length=255)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,60}$")]


class ScopeAnswer(NamedTuple):
    """A body and its media type."""

    body: bytes
    kind: str


class _Question(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _StretchQuestion(_Question):
    log: LogName
    first: Tick
    last: Tick

    def stretch(self) -> TickRange:
        return TickRange(self.log, self.first, self.last)


class _EventsQuestion(_Question):
    log: LogName


class _TicksQuestion(_StretchQuestion):
    fields: Annotated[str, Field(max_length=2000)]
    every: Annotated[int, Field(ge=1, le=100_000)] = 1


class _TriggerQuestion(_Question):
    log: LogName
    field: Name
    level: float
    slope: Slope
    hysteresis: Annotated[float, Field(ge=0)] = 0.0
    after: Tick = -1
    armed: Literal["", "r", "f", "rf"] = ""


class ScopeQuestions:
    """Answers the questions of all pages; keeps nothing between them."""

    def __init__(self, memory: TickMemory, source: TickSource) -> None:
        """Answer from these."""
        self._memory = memory
        self._source = source

    def answer(self, path: str, query: dict[str, str]) -> ScopeAnswer:
        """Answer one question. Raises `PageRefusal`."""
        try:
            match path:
                case "/scope/state":
                    return self._tell_state()
                case "/scope/trigger":
                    return self._search(_TriggerQuestion.model_validate(query))
                case "/scope/ticks":
                    return self._send_ticks(_TicksQuestion.model_validate(query))
                case "/scope/events":
                    log = _EventsQuestion.model_validate(query).log
                    return _encode(self._source.read_events(log))
                case "/scope/cut":
                    cut = self._source.cut(_StretchQuestion.model_validate(query).stretch())
                    return ScopeAnswer(cut, _BINARY)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise PageRefusal(f"{where}: {first['msg']}") from None
        raise PageRefusal("there is no such page", HTTPStatus.NOT_FOUND)

    def _tell_state(self) -> ScopeAnswer:
        held = self._memory.state()
        return _encode({**held._asdict(), "events": self._memory.events()})

    def _search(self, asked: _TriggerQuestion) -> ScopeAnswer:
        armed = Armed("r" in asked.armed, "f" in asked.armed)
        found = self._source.search(
            asked.log, asked.field, asked.after, asked.level, asked.slope, asked.hysteresis, armed
        )
        letters = ("r" if found.armed.rising else "") + ("f" if found.armed.falling else "")
        return _encode({**found._asdict(), "armed": letters})

    def _send_ticks(self, asked: _TicksQuestion) -> ScopeAnswer:
        names = asked.fields.split(",")
        columns = self._source.read_columns(asked.stretch(), names, asked.every)
        body = b"".join(np.ascontiguousarray(columns[name], "<f8").data for name in names)
        return ScopeAnswer(body, _BINARY)


def _encode(document: Any) -> ScopeAnswer:
    text = json.dumps(_replace_nan(document), separators=(",", ":"), allow_nan=False)
    return ScopeAnswer(text.encode(), _JSON)


def _replace_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_nan(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
