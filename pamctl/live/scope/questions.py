"""What the page may ask the scope, as the query of an address; the answers as bytes.

/scope/state                              what is held, and the events of the run
/scope/trigger?log=&field=&level=&slope=&hysteresis=&after=&armed=
/scope/ticks?log=&first=&last=&every=&fields=a,b     columns of little-endian doubles
/scope/cut?log=&first=&last=              a log of its own
/scope/events?log=                        marks, trips and other events, each with its tick
"""

from __future__ import annotations

import json
import math
from http import HTTPStatus
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pamctl.live.scope.tick_memory import TickMemory
from pamctl.live.scope.tick_source import ScopeRefusal, TickRange, TickSource
from pamctl.live.scope.trigger import Armed, Slope

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
        """Answer one question. Raises `ScopeRefusal`."""
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
            raise ScopeRefusal(HTTPStatus.BAD_REQUEST, f"{where}: {first['msg']}") from None
        raise ScopeRefusal(HTTPStatus.NOT_FOUND, "there is no such page")

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
