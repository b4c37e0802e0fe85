"""Where a viewer's values come from: the daemon's control socket."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError

_PATIENCE_S = 5.0


class Glimpse(NamedTuple):
    """What is new since the last look."""

    status: dict[str, Any] | None
    """Status as the daemon sends it; None while it does not answer."""
    ticks: list[dict[str, float]]
    """Columns by name, oldest first; NaN where a value is unknown."""
    problem: str = ""
    """Why nothing can be seen; empty if all is well."""


class DaemonFeed:
    """A client of the control socket; finds the daemon again when it has been restarted."""

    def __init__(self, path: Path, every: int, fields: Sequence[str] | None = None) -> None:
        """Ask for the tick whose number `every` divides, and these columns of it, or all."""
        self._path = path
        self._every = every
        self._fields = None if fields is None else list(fields)
        self._client: Client | None = None
        self._seen = -1

    def look(self) -> Glimpse:
        """Return what is new. A daemon that is gone is no error: it may come back."""
        was_connected = self._client is not None
        try:
            return self._ask()
        except (DaemonUnreachableError, DaemonDeclinedError) as error:
            self.close()
            # It may have been restarted in the meantime.
            return self.look() if was_connected else Glimpse(None, [], str(error))

    def _ask(self) -> Glimpse:
        if self._client is None:
            self._client, self._seen = Client(self._path, _PATIENCE_S), -1
        status = self._client.call("status")
        newest = -1 if status["tick"] is None else int(status["tick"]["tick"])
        if newest < self._seen:
            self._seen = -1  # another session counts from zero
        request = {"after_tick": self._seen, "every": self._every, "fields": self._fields}
        answer = self._client.call("recent", request)
        ticks = [
            {
                name: math.nan if value is None else value
                for name, value in zip(answer["fields"], row, strict=True)
            }
            for row in answer["ticks"]
        ]
        self._seen = newest
        if ticks and "tick" in ticks[-1]:
            self._seen = max(newest, int(ticks[-1]["tick"]))
        return Glimpse(status, ticks)

    def close(self) -> None:
        """Hang up."""
        if self._client is not None:
            self._client.close()
            self._client = None
