"""One client of the daemon that serves all viewers of the page."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path

from pamctl.live.feed import DaemonFeed, Glimpse
from pamctl.live.line import COLUMNS, EVERY, LOOKS_PER_S, encode_glimpses

_KEPT_LOOKS = round(60 * LOOKS_PER_S)


class Broadcast:
    """Looks at the daemon ten times a second, and keeps the last minute for new viewers."""

    def __init__(self, socket: Path) -> None:
        """Begin to look now."""
        self._feed = DaemonFeed(socket, EVERY, COLUMNS)
        self._news = threading.Condition()
        self._kept: deque[Glimpse] = deque(maxlen=_KEPT_LOOKS)
        self._count = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._poll_feed, name="broadcast", daemon=True)
        self._thread.start()

    def _poll_feed(self) -> None:
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
            return self._count, encode_glimpses(fresh)

    def end(self) -> None:
        """Stop looking."""
        self._ended.set()
        self._thread.join()
