"""What happens, a line of JSON each, for whoever reads the daemon's standard output.

A reader that is slow, stuck or gone holds up nobody: lines wait in a queue, and a thread of
their own writes them. Where the queue is full, lines are left out.
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
    """Lines for a reader."""

    def __init__(self, fd: int) -> None:
        """Write to `fd`, past Python's buffer: at the end nobody waits for what is stuck there."""
        self._fd = fd
        self._waiting: queue.Queue[bytes] = queue.Queue(_MOST_WAITING)
        self._thread = threading.Thread(target=self._write, name="announcements", daemon=True)
        self._thread.start()

    def put(self, event: Mapping[str, object]) -> None:
        """Announce; never wait."""
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
