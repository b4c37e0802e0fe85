"""What the page can set and order: its forms, and orders that the daemon carries out.

The emergency stop waits for nobody. Another order may take seconds, as the first `goto` does, which
starts the loop. It is confirmed when it is on its way; how it ended is told with the news.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as wait_for_any
from functools import cache
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from pamctl.control.law_registry import find_law
from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError
from pamctl.realtime.gain_ramp import DEFAULT_RAMP_S
from pamctl.runs.run_filter import RunFilter, select_runs
from pamctl.runs.run_index import RunIndex, RunsError
from pamctl.settings.config_files import config_dir, list_shipped
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import read_section_file, settings_to_data
from pamctl.signals import TICK_FIELDS, Phase

_MOST_RUNS = 100
_RUN_COLUMNS = (
    "path", "when_s", "controller", "experiment", "ending", "duration_s", "max_um", "rms_um",
    "steady_um", "operator", "note",
)  # fmt: skip

Form = dict[str, Any]

_BOUNDS = {
    "minimum": "low", "exclusiveMinimum": "above", "maximum": "high", "exclusiveMaximum": "below",
}  # fmt: skip


def describe_bench(status: Mapping[str, Any] | None) -> Form:
    """Return all that the page makes its forms of; without a daemon there are no gains."""
    gains = [] if status is None else describe_gains(status["controller"])
    limits = None if status is None else status["limits"]["stroke_mm"]
    return {
        "fields": describe_fields(), "phases": describe_phases(), "gains": gains,
        "experiments": list_experiments(), "stroke_mm": limits,
        "rate_hz": None if status is None else status["rate_hz"],
    }  # fmt: skip


def list_runs(status: Mapping[str, Any] | None) -> list[Form]:
    """Return the newest logs of the daemon's folder by its index, newest first."""
    try:
        folder = Path("/nonexistent" if status is None else status["logs"])
        with RunIndex(folder) as index:
            index.refresh()
            rows = select_runs(index, RunFilter(last=_MOST_RUNS), with_gains=False)
    except RunsError:
        return []
    return [{name: getattr(row, name) for name in _RUN_COLUMNS} for row in reversed(rows)]


def describe_fields() -> list[Form]:
    """Return the columns of a tick, with the stage that makes each."""
    return [{"name": field.name, "stage": field.stage} for field in TICK_FIELDS]


def describe_phases() -> list[str]:
    """Return the names of the phases by number."""
    return [phase.name.lower().replace("_", " ") for phase in Phase]


def describe_gains(controller: Mapping[str, Any]) -> list[Form]:
    """Return the numbers of a controller, each with the schema's bounds.

    `runs` says whether it may change while the law runs.
    """
    law = find_law(str(controller["law"]))
    keys = law.settings.model_json_schema()["properties"]
    return [
        {
            "name": name,
            "value": value,
            "about": keys[name].get("description", ""),
            "runs": law.may_blend(name),
            **{_BOUNDS[bound]: at for bound, at in keys[name].items() if bound in _BOUNDS},
        }
        for name, value in controller.items()
        if isinstance(value, float | int) and not isinstance(value, bool) and name in keys
    ]


@cache
def list_experiments() -> list[Form]:
    """Return the shipped experiments, each with its keys that are numbers."""
    return [
        {"name": name, "numbers": _numbers_of(load_shipped_experiment(name))}
        for name in list_shipped("experiment")
    ]


def load_shipped_experiment(name: str, changes: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a shipped experiment with `amplitude_mm=2` and the like; raise `ConfigError`."""
    if name not in list_shipped("experiment"):  # a path is not opened for a browser
        raise ConfigError([Problem(name, "", "there is no such experiment")])
    path = config_dir() / "experiment" / f"{name}.yaml"
    return settings_to_data(read_section_file("experiment", path, changes))


def _numbers_of(experiment: Mapping[str, Any]) -> dict[str, float]:
    return {
        key: value
        for key, value in experiment.items()
        if isinstance(value, float | int) and not isinstance(value, bool)
    }


_Key = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,60}$")]
_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]

_Ramp = Annotated[float, Field(strict=True, ge=0, le=60)]
_Operator = Annotated[str, Field(max_length=100)]


class OrderNotUnderstood(ValueError):
    """The order is not one of the page's. The message says what is."""


class _Order(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Plain(_Order):
    do: Literal["estop", "stop", "ack", "disarm"]


class _Undo(_Order):
    do: Literal["undo"]
    ramp_s: _Ramp = DEFAULT_RAMP_S
    operator: _Operator = ""


class _Goto(_Order):
    do: Literal["goto"]
    position_mm: _Number


class _Set(_Order):
    do: Literal["set"]
    gains: Annotated[dict[_Key, _Number], Field(min_length=1, max_length=32)]
    ramp_s: _Ramp = DEFAULT_RAMP_S
    operator: _Operator = ""


class _Mark(_Order):
    do: Literal["mark"]
    text: Annotated[str, Field(min_length=1, max_length=1000)]


class _Start(_Order):
    do: Literal["start"]
    experiment: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]
    numbers: Annotated[dict[_Key, _Number], Field(max_length=32)] = {}
    operator: _Operator = ""


_ORDERS: TypeAdapter[_Plain | _Undo | _Goto | _Set | _Mark | _Start] = TypeAdapter(
    Annotated[_Plain | _Undo | _Goto | _Set | _Mark | _Start, Field(discriminator="do")]
)


def translate_order(order: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return method and parameters. Raises `OrderNotUnderstood`."""
    try:
        asked = _ORDERS.validate_python(order)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the order"
        raise OrderNotUnderstood(f"{where}: {first['msg']}") from None
    match asked:
        case _Goto():
            return "goto", {"position_m": asked.position_mm * 1e-3}
        case _Set():
            changes = [f"controller.{name}={value!r}" for name, value in asked.gains.items()]
            return "set", {"changes": changes, "ramp_s": asked.ramp_s, "operator": asked.operator}
        case _Undo():
            return "undo", {"ramp_s": asked.ramp_s, "operator": asked.operator}
        case _Mark():
            return "mark", {"text": asked.text}
        case _Start():
            return "start", _fill_start(asked)
    return asked.do, {}


def _fill_start(asked: _Start) -> dict[str, Any]:
    changes = tuple(f"{name}={_spell(value)}" for name, value in asked.numbers.items())
    try:
        experiment = load_shipped_experiment(asked.experiment, changes)
    except ConfigError as error:
        raise OrderNotUnderstood(str(error)) from None
    return {"experiment": experiment, "name": asked.experiment, "operator": asked.operator}


def _spell(value: float) -> str:
    """Whole numbers without a point: some keys count."""
    return str(int(value)) if value.is_integer() else repr(value)


_PATIENCE_S = 30.0
"""A driver may take seconds to start (s)."""
_ESTOP_PATIENCE_S = 5.0
"""The page asks again."""
_CONFIRMED_WITHIN_S = 0.1
"""Most orders have ended by then, and are answered with their outcome (s)."""
_MOST_WAITING = 8
_KEPT_OUTCOMES = 32


class OrderFailure(Exception):
    """An order that was not carried out, with the status of its answer."""

    def __init__(self, status: HTTPStatus, message: str) -> None:
        """`message` is for people."""
        super().__init__(message)
        self.status = status


class PageOrders:
    """Gives orders to the daemon, and keeps the outcome of those that take longer."""

    def __init__(self, socket: Path) -> None:
        """Give orders to the daemon behind `socket`."""
        self._socket = socket
        self._numbers = itertools.count(1)
        self._waiting = threading.BoundedSemaphore(_MOST_WAITING)
        # One after the other, as the daemon takes them.
        self._worker = ThreadPoolExecutor(1, "orders")
        self._outcomes: deque[dict[str, Any]] = deque(maxlen=_KEPT_OUTCOMES)

    def give(self, method: str, params: Mapping[str, object]) -> int | None:
        """Carry out an order; return its number if it has not ended yet, else None.

        Raises `OrderFailure`.
        """
        if method == "estop":
            self._call(method, params, _ESTOP_PATIENCE_S)
            return None
        if not self._waiting.acquire(blocking=False):
            raise OrderFailure(HTTPStatus.TOO_MANY_REQUESTS, "too many orders are waiting")
        number = next(self._numbers)
        outcome = self._worker.submit(self._carry_out, number, method, params)
        if not wait_for_any([outcome], _CONFIRMED_WITHIN_S).done:
            return number
        failure = outcome.result()
        if failure is not None:
            raise failure
        return None

    def _carry_out(
        self, number: int, method: str, params: Mapping[str, object]
    ) -> OrderFailure | None:
        failure: OrderFailure | None = None
        try:
            self._call(method, params)
        except OrderFailure as error:
            failure = error
        finally:
            self._waiting.release()
        self._outcomes.append(
            {"order": number, "do": method, "error": "" if failure is None else str(failure)}
        )
        return failure

    def _call(
        self, method: str, params: Mapping[str, object], patience_s: float = _PATIENCE_S
    ) -> None:
        try:
            with Client(self._socket, patience_s) as client:
                client.call(method, params)
        except DaemonDeclinedError as error:
            raise OrderFailure(HTTPStatus.CONFLICT, str(error)) from None
        except DaemonUnreachableError as error:
            raise OrderFailure(HTTPStatus.SERVICE_UNAVAILABLE, str(error)) from None

    def outcomes(self) -> list[dict[str, Any]]:
        """Return how the last orders ended, oldest first."""
        return list(self._outcomes)

    def end(self) -> None:
        """Take no more orders; those on their way go on."""
        self._worker.shutdown(wait=False, cancel_futures=True)
