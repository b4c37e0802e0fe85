"""One client of the daemon that serves all viewers of the page."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pamctl.live.feed import DaemonFeed, Glimpse
from pamctl.live.line import COLUMNS, EVERY, LOOKS_PER_S, describe_glimpses
from pamctl.live.scope.tick_memory import TickMemory
from pamctl.live.scope.tick_source import TickSource

_KEPT_LOOKS = round(60 * LOOKS_PER_S)
_FOLLOW_EVERY_S = 0.05


class Broadcast:
    """Looks at the daemon ten times a second, and keeps the last minute for new viewers."""

    def __init__(self, socket: Path) -> None:
        """Begin to look now."""
        self._feed = DaemonFeed(socket, EVERY, COLUMNS)
        self.memory = TickMemory()
        self.source = TickSource(self.memory)
        self._news = threading.Lock()
        self._kept: deque[Glimpse] = deque(maxlen=_KEPT_LOOKS)
        self._count = 0
        self._looked_s = time.monotonic()
        self._ended = threading.Event()
        # A daemon that is slow to answer must not cost ticks: the ring goes on without it.
        self._threads = [
            threading.Thread(target=work, daemon=True)
            for work in (self._poll_feed, self._follow_run)
        ]
        for thread in self._threads:
            thread.start()

    def _poll_feed(self) -> None:
        while not self._ended.wait(1.0 / LOOKS_PER_S):
            glimpse = self._feed.look()
            with self._news:
                self._kept.append(glimpse)
                self._count += 1
                self._looked_s = time.monotonic()
        self._feed.close()

    def _follow_run(self) -> None:
        while not self._ended.wait(_FOLLOW_EVERY_S):
            status = self.newest_status()
            if status is None:
                self.memory.follow(None, None)
                continue
            self.source.folder = Path(status["logs"])
            self.memory.follow(status.get("ring"), status["log"])
        self.memory.close()

    def newest_status(self) -> dict[str, Any] | None:
        """Return the daemon's status; None while it does not answer."""
        with self._news:
            return self._kept[-1].status if self._kept else None

    def encode_news(self, seen: int, more: Mapping[str, object]) -> bytes:
        """Return as JSON: all since look number `seen`, the newest state, and `more`.

        `look` is the number to name next time; `age_s` is the time since the newest look.
        """
        with self._news:
            missing = min(max(self._count - seen, 0), len(self._kept))
            fresh = [self._kept[len(self._kept) - missing + i] for i in range(missing)]
            newest = self._kept[-1] if self._kept else None
            count, age_s = self._count, time.monotonic() - self._looked_s
        document = describe_glimpses(fresh, newest)
        return json.dumps(
            {"look": count, "age_s": age_s, **more, **document},
            separators=(",", ":"),
            allow_nan=False,
        ).encode()

    def end(self) -> None:
        """Stop looking."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
