"""What the page can set and order: its forms, and orders that the daemon carries out.

The emergency stop waits for nobody. Another order may take seconds, as the first `goto` does, which
starts the loop. It is confirmed when it is on its way; how it ended is told with the news.
"""

from __future__ import annotations

import itertools
import math
import re
import threading
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from http import HTTPStatus
from pathlib import Path
from typing import Any

from pamctl.base.errors import ConfigError, Problem
from pamctl.control.law_registry import find_law
from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError
from pamctl.daemon.protocol import RequestError, check_params, list_orders
from pamctl.daemon.rig_session import RigSession
from pamctl.runs.run_index import RunFilter, RunIndex, RunsError, select_runs
from pamctl.settings.config_files import config_dir, list_shipped, read_section
from pamctl.signals import TICK_FIELDS, Phase

_MOST_RUNS = 100
_RUN_COLUMNS = (
    "path", "when_s", "controller", "experiment", "ending", "duration_s", "max_um", "rms_um",
    "steady_um", "operator", "note",
)  # fmt: skip


class PageRefusal(Exception):
    """What a page asked for is refused, with the status of the answer."""

    def __init__(self, message: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> None:
        """`message` is for people."""
        super().__init__(message)
        self.status = status


Form = dict[str, Any]
_KEY = re.compile(r"[a-z][a-z0-9_]{0,60}")

_BOUNDS = {
    "minimum": "low", "exclusiveMinimum": "above", "maximum": "high", "exclusiveMaximum": "below",
}  # fmt: skip


def describe_bench(status: Mapping[str, Any] | None) -> Form:
    """Return all that the page makes its forms of; without a daemon there are no gains."""
    gains = [] if status is None else describe_gains(status["controller"])
    limits = None if status is None else status["limits"]["stroke_mm"]
    return {
        "fields": [{"name": field.name, "stage": field.stage} for field in TICK_FIELDS],
        "phases": [phase.name.lower().replace("_", " ") for phase in Phase], "gains": gains,
        "experiments": list_experiments(), "stroke_mm": limits,
        "rate_hz": None if status is None else status["rate_hz"],
    }  # fmt: skip


def list_runs(status: Mapping[str, Any] | None) -> list[Form]:
    """Return the newest logs of the daemon's folder by its index, newest first."""
    try:
        folder = Path("/nonexistent" if status is None else status["logs"])
        index = RunIndex(folder)
        index.refresh()
        rows = select_runs(index, RunFilter(last=_MOST_RUNS))
    except RunsError:
        return []
    return [{name: getattr(row, name) for name in _RUN_COLUMNS} for row in reversed(rows)]


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
    return read_section("experiment", path, changes)


def _numbers_of(experiment: Mapping[str, Any]) -> dict[str, float]:
    return {
        key: value
        for key, value in experiment.items()
        if isinstance(value, float | int) and not isinstance(value, bool)
    }


def translate_order(asked: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return an order and its parameters, checked by its signature; raise `PageRefusal`.

    The page gives `{"do": ORDER, ...}` in its own units: millimetres, gains by name, a shipped
    experiment with some of its numbers.
    """
    given = dict(asked)
    name = given.pop("do", None)
    orders = {name: told for name, told in list_orders(RigSession).items() if told.on_page}
    told = orders.get(name) if isinstance(name, str) else None
    if told is None:
        raise PageRefusal(f"do: the page gives {', '.join(orders)}")
    try:
        match told.name:
            case "goto":
                given["position_m"] = _read_number(given.pop("position_mm", None)) * 1e-3
            case "set":
                gains = _read_numbers(given.pop("gains", None))
                given["changes"] = [f"controller.{key}={gain!r}" for key, gain in gains.items()]
            case "start":
                given["name"] = str(given.get("experiment"))
                numbers = _read_numbers(given.pop("numbers", {}))
                changes = tuple(f"{key}={_spell(value)}" for key, value in numbers.items())
                given["experiment"] = load_shipped_experiment(given["name"], changes)
        check_params(told.params, given)
    except (ConfigError, RequestError) as error:
        raise PageRefusal(str(error)) from None
    return told.name, given


def _read_numbers(numbers: object) -> dict[str, float]:
    if not isinstance(numbers, dict) or not all(map(_KEY.fullmatch, numbers)):
        raise PageRefusal("give numbers by their keys")
    return {key: _read_number(value) for key, value in numbers.items()}


def _read_number(value: object) -> float:
    try:
        if isinstance(value, float | int) and not isinstance(value, bool):
            number = float(value)
            if math.isfinite(number):
                return number
    except OverflowError:
        pass
    raise PageRefusal(f"{value!r:.50} is no number")


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

        Raises `PageRefusal`.
        """
        if method == "estop":
            self._call(method, params, _ESTOP_PATIENCE_S)
            return None
        if not self._waiting.acquire(blocking=False):
            raise PageRefusal("too many orders are waiting", HTTPStatus.TOO_MANY_REQUESTS)
        number = next(self._numbers)
        outcome = self._worker.submit(self._carry_out, number, method, params)
        try:
            outcome.result(_CONFIRMED_WITHIN_S)
        except TimeoutError:
            return number
        return None

    def _carry_out(self, number: int, method: str, params: Mapping[str, object]) -> None:
        outcome = {"order": number, "do": method, "error": ""}
        try:
            self._call(method, params)
        except PageRefusal as refusal:
            outcome["error"] = str(refusal)
            raise
        finally:
            self._waiting.release()
            self._outcomes.append(outcome)

    def _call(
        self, method: str, params: Mapping[str, object], patience_s: float = _PATIENCE_S
    ) -> None:
        try:
            with Client(self._socket, patience_s) as client:
                client.call(method, params)
        except DaemonDeclinedError as error:
            raise PageRefusal(str(error), HTTPStatus.CONFLICT) from None
        except DaemonUnreachableError as error:
            raise PageRefusal(str(error), HTTPStatus.SERVICE_UNAVAILABLE) from None

    def outcomes(self) -> list[dict[str, Any]]:
        """Return how the last orders ended, oldest first."""
        return list(self._outcomes)

    def end(self) -> None:
        """Take no more orders; those on their way go on."""
        self._worker.shutdown(wait=False, cancel_futures=True)
