"""Orders of the page: confirmed at once, carried out by the daemon.

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
from http import HTTPStatus
from pathlib import Path
from typing import Any

from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError

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
