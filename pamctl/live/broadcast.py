"""One client of the daemon on behalf of all viewers of the page."""

from __future__ import annotations

import json
import math
import threading
from collections import deque
from pathlib import Path
from typing import Any

from pamctl.live.feed import DaemonFeed, Glimpse

LOOKS_PER_S = 10.0
EVERY = 20
"""Ticks, of those that are plotted: 50 points a second."""
COLUMNS = ("tick", "t_s", "phase", "position_m", "reference_m", "pressure_pa", "valve_v")
_KEPT_LOOKS = round(60 * LOOKS_PER_S)
_TOLD = (
    "state", "fault", "run", "log", "worst_late_s", "missed_ticks", "backend", "device",
    "limits", "names", "disk_free_bytes", "version", "events",
)  # fmt: skip


class Broadcast:
    """Looks at the daemon ten times a second, and keeps the last minute for who comes later."""

    def __init__(self, socket: Path) -> None:
        """Begin to look at once."""
        self._feed = DaemonFeed(socket, EVERY, COLUMNS)
        self._news = threading.Condition()
        self._kept: deque[Glimpse] = deque(maxlen=_KEPT_LOOKS)
        self._count = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look_on, name="broadcast", daemon=True)
        self._thread.start()

    def _look_on(self) -> None:
        while not self._ended.wait(1.0 / LOOKS_PER_S):
            glimpse = self._feed.look()
            with self._news:
                self._kept.append(glimpse)
                self._count += 1
                self._news.notify_all()
        self._feed.close()

    def after(self, seen: int, patience_s: float) -> tuple[int, str]:
        """Wait for news since look number `seen`; return the newest number and all as JSON."""
        with self._news:
            self._news.wait_for(lambda: self._count > seen, patience_s)
            missing = min(self._count - seen, len(self._kept))
            fresh = [self._kept[len(self._kept) - missing + i] for i in range(missing)]
            return self._count, _told(fresh)

    def end(self) -> None:
        """Look no more."""
        self._ended.set()
        self._thread.join()


def _told(glimpses: list[Glimpse]) -> str:
    newest = glimpses[-1] if glimpses else Glimpse(None, [])
    status: dict[str, Any] | None = None
    if newest.status is not None:
        status = {name: newest.status[name] for name in _TOLD}
    rows = [[_number(tick[name]) for name in COLUMNS] for one in glimpses for tick in one.ticks]
    document = {"status": status, "problem": newest.problem, "fields": COLUMNS, "ticks": rows}
    return json.dumps(document, separators=(",", ":"), allow_nan=False)


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
