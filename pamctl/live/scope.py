"""The scope of the page: ticks by log and number, and searches for a trigger in them.

    /scope/state                              what is held, and the events of the run
    /scope/trigger?log=&field=&level=&slope=&hysteresis=&after=&armed=
    /scope/ticks?log=&first=&last=&every=&fields=a,b     columns of little-endian doubles
    /scope/cut?log=&first=&last=              a log of its own
    /scope/events?log=                        marks, trips and other events, each with its tick

Ticks come from memory while they are there, else from the log's file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, ValidationError, validate_call

from pamctl.base.texts import clean_document, to_plain_json
from pamctl.live.page_orders import PageRefusal
from pamctl.live.tick_memory import TickMemory
from pamctl.log.edit import cut_log
from pamctl.log.framing import LogError
from pamctl.log.reader import read

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
_LAST_TICK = (1 << 53) - 1
"""The largest number that a browser holds exactly."""
Tick = Annotated[int, Field(ge=-1, le=_LAST_TICK)]
LogName = Annotated[str, Field(min_length=1, max_length=255)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,60}$")]
_QUESTIONS = ("state", "trigger", "ticks", "events", "cut")


class Scope:
    """Answers the questions of all pages: each is the method of that name, with its parameters.

    Every one may raise `PageRefusal`. Nothing is kept between them.
    """

    def __init__(self, memory: TickMemory) -> None:
        """Ask `memory` first, then the files of `folder`."""
        self._memory = memory
        self.folder: Path | None = None
        """The daemon's logs; None before the daemon has answered."""

    def answer(self, path: str, query: Mapping[str, str]) -> tuple[bytes, str]:
        """Answer one question by a body and its media type."""
        name = path.removeprefix("/scope/")
        if name not in _QUESTIONS:
            raise PageRefusal("there is no such page", HTTPStatus.NOT_FOUND)
        try:
            answer = getattr(self, name)(**query)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise PageRefusal(f"{where}: {first['msg']}") from None
        if isinstance(answer, bytes):
            return answer, "application/octet-stream"
        return to_plain_json(answer).encode(), "application/json"

    @validate_call
    def state(self) -> dict[str, Any]:
        """Return what is held, and the events of the run."""
        return {**self._memory.state()._asdict(), "events": self._memory.events()}

    @validate_call
    def trigger(
        self,
        log: LogName,
        field: Name,
        level: FiniteFloat,
        slope: Slope,
        hysteresis: Annotated[FiniteFloat, Field(ge=0)] = 0.0,
        after: Tick = -1,
        armed: Literal["", "r", "f", "rf"] = "",
    ) -> dict[str, Any]:
        """Search the ticks behind `after` for the first crossing.

        `searched` is the last tick that was looked at: the next search begins behind it, with
        `armed`, which has a letter for each slope.
        """
        columns = self._read_columns(log, after + 1, 1 << 62, ("tick", "t_s", field))
        begun = Armed("r" in armed, "f" in armed)
        at, left = find_crossing(columns[field], level, slope, hysteresis, begun)
        ticks = columns["tick"]
        return {
            "tick": None if at is None else int(ticks[at]),
            "t_s": None if at is None else float(columns["t_s"][at]),
            "searched": int(ticks[-1]) if len(ticks) else after,
            "armed": "r" * left.rising + "f" * left.falling,
        }

    @validate_call
    def ticks(
        self,
        log: LogName,
        first: Tick,
        last: Tick,
        fields: Annotated[str, Field(max_length=2000)],
        every: Annotated[int, Field(ge=1, le=100_000)] = 1,
    ) -> bytes:
        """Return columns of every `every`th tick, both ends included."""
        names = fields.split(",")
        columns = self._read_columns(log, first, last, names, every)
        return b"".join(np.ascontiguousarray(columns[name], "<f8").data for name in names)

    @validate_call
    def events(self, log: LogName) -> list[dict[str, Any]]:
        """Return the events of a log, oldest first, each with its `tick`."""
        if self._memory.state().log == log:
            return self._memory.events()
        with _refuse_bad_logs():
            events = read(self._require_log(log), fields=("tick",)).events
        return [clean_document(event) for event in events]

    @validate_call
    def cut(self, log: LogName, first: Tick, last: Tick) -> bytes:
        """Return a stretch of a finished log as a log of its own."""
        source = self._require_log(log)
        if self._memory.is_following(log):
            raise PageRefusal(
                "the run goes on: its log can be cut when it is over", HTTPStatus.CONFLICT
            )
        with _refuse_bad_logs(), tempfile.TemporaryDirectory() as place:
            rows = _find_rows(read(source, fields=("tick",))["tick"], first, last)
            piece = Path(place) / "cut.mcap"
            cut_log(source, piece, from_row=rows.start, to_row=rows.stop)
            return piece.read_bytes()

    def _read_columns(
        self, log: str, first: int, last: int, names: Sequence[str], every: int = 1
    ) -> Mapping[str, NDArray[np.float64]]:
        """Read from memory where all of it is there, else from the file."""
        held = self._memory.state()
        if log == held.log and (held.is_complete or held.first_tick <= first):
            try:
                columns = self._memory.read_columns(names, first, last, every)
            except KeyError as error:
                raise PageRefusal(f"no field {error.args[0]}") from None
        else:
            with _refuse_bad_logs():
                found = read(self._require_log(log), fields=dict.fromkeys(["tick", *names]))
                rows = _find_rows(found["tick"], first, last)
                part = slice(rows.start, rows.stop, every)
                columns = {name: found[name][part].astype(np.float64) for name in names}
        if sum(map(len, columns.values())) > MOST_VALUES:
            raise PageRefusal(
                f"more than {MOST_VALUES} values: choose a shorter time or fewer fields",
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
            )
        return columns

    def _require_log(self, name: str) -> Path:
        """Return the path of a log of the daemon's folder; names with a folder are refused."""
        if self.folder is None or Path(name).name != name or not name.endswith(".mcap"):
            raise PageRefusal("there is no such log", HTTPStatus.NOT_FOUND)
        path = self.folder / name
        if not path.is_file():
            raise PageRefusal(
                "there is no such log yet: it is whole when the run is over", HTTPStatus.NOT_FOUND
            )
        return path


@contextmanager
def _refuse_bad_logs() -> Iterator[None]:
    try:
        yield
    except (LogError, OSError) as error:
        raise PageRefusal(str(error), HTTPStatus.CONFLICT) from None


def _find_rows(tick: NDArray[Any], first: int, last: int) -> slice:
    """Return the rows from tick `first` to tick `last`, both included."""
    return slice(int(np.searchsorted(tick, first, "left")), int(tick.searchsorted(last, "right")))
