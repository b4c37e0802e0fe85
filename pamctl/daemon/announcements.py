"""Events on the daemon's standard output, one line of JSON each.

A reader that is slow, stuck or gone delays nobody: the lines wait in a queue, and a thread
writes them. When the queue is full, lines are dropped.
"""

from __future__ import annotations

import json
import os
import queue
import threading
from collections.abc import Mapping
from contextlib import suppress

_MOST_WAITING = 1000
_LAST_PATIENCE_S = 1.0


class Announcements:
    """A queue of lines, and the thread that writes them."""

    def __init__(self, fd: int) -> None:
        """Write to `fd` without Python's buffer: a stuck line cannot delay the exit."""
        self._fd = fd
        self._waiting: queue.Queue[bytes] = queue.Queue(_MOST_WAITING)
        self._thread = threading.Thread(target=self._write, name="announcements", daemon=True)
        self._thread.start()

    def put(self, event: Mapping[str, object]) -> None:
        """Put an event into the queue; never wait."""
        with suppress(queue.Full):
            self._waiting.put_nowait(json.dumps(event).encode() + b"\n")

    def end(self) -> None:
        """Wait a moment for the last lines to be written."""
        with suppress(queue.Full):
            self._waiting.put_nowait(b"")
        self._thread.join(_LAST_PATIENCE_S)

    def _write(self) -> None:
        with suppress(OSError):  # the reader has gone
            while line := self._waiting.get():
                while line:
                    line = line[os.write(self._fd, line) :]
