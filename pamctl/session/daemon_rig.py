"""The rig of a running daemon, steered through its control socket."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pamctl.base.errors import ExitCode
from pamctl.daemon.client import (
    Client,
    DaemonDeclinedError,
    default_socket,
    read_ticks,
    restore_nan,
)
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.steered_rig import Goal, SteeredRig, require_well

_LOOK_EVERY_S = 0.05


def connect(socket: str | Path | None = None) -> DaemonRig:
    """Connect to a running daemon; `socket` is its control socket [default: as `pamctl status`].

    Raises `PamctlError` with exit code 69 where no daemon answers.
    """
    with translate_errors():
        return DaemonRig(Path(socket) if socket is not None else default_socket())


class DaemonRig(SteeredRig):
    """A client of the daemon.

    When it is closed it stops the run or the held position that was begun here: the valve goes to
    the safe voltage on the stop's ramp, and the muscle stays homed. Runs of other clients go on.
    If this process is killed, the daemon finishes the run by itself.
    """

    def __init__(self, socket: Path) -> None:
        """Connect; raise `DaemonUnreachableError`."""
        super().__init__(_SocketLink(socket))
        self.status()


class _SocketLink:
    """A connection to the daemon, which is made anew where an answer was not waited for."""

    is_own, has_end = False, True

    def __init__(self, socket: Path) -> None:
        self._socket = socket
        self._client: Client | None = Client(socket)
        self._is_open = True

    def ask(self, name: str, params: Mapping[str, object]) -> Any:
        if not self._is_open:
            raise PamctlError("this connection is closed; connect again", ExitCode.USAGE)
        client = self._client = self._client or Client(self._socket)
        try:
            return client.call(name, params)
        except DaemonDeclinedError:
            raise
        except BaseException:
            # Its answer may still come: another request needs another connection.
            self._client = None
            client.close()
            raise

    def ask_at_once(self, name: str) -> Any:
        with Client(self._socket) as client:
            return client.call(name)

    def wait_until(self, goal: Goal, patience_s: float = math.inf) -> None:
        deadline_s = time.monotonic() + patience_s
        while True:
            status = self.ask("status", {})
            seen = _Seen(status)
            if (
                goal(seen)
                or (status["fault"] and not seen.has_loop)
                or time.monotonic() > deadline_s
            ):
                return
            self.sleep(_LOOK_EVERY_S)

    def sleep(self, duration_s: float) -> None:
        time.sleep(duration_s)

    def follow(self, every: int) -> Iterator[Mapping[str, float]]:
        status = self.ask("status", {})
        newest = -1 if status["tick"] is None else int(status["tick"]["tick"])
        while True:
            goes_on = require_well(self.ask("status", {}))["run"] is not None
            for tick in read_ticks(self.ask("recent", {"after_tick": newest, "every": every})):
                newest = int(tick["tick"])
                yield tick
            if not goes_on:
                return
            self.sleep(_LOOK_EVERY_S)

    def close(self) -> None:
        self._is_open = False
        if self._client is not None:
            self._client.close()


class _Seen:
    """A status, as waits look at it."""

    def __init__(self, status: Mapping[str, Any]) -> None:
        self._status = status
        self.log: str | None = status["log"]
        self.has_loop = "loop" in status["pids"]

    @property
    def tick(self) -> Mapping[str, float] | None:
        tick = self._status["tick"]
        return None if tick is None else restore_nan(tick)
