"""The fault that is not acknowledged yet: it outlives the daemon.

A service manager that restarts a daemon must not make it forget why the muscle stands still.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from hal.reservation import open_shared
from hal.rig import RigError


class Latch:
    """A reason, kept in shared memory until it is taken away: gone with the next boot."""

    def __init__(self, path: Path) -> None:
        """Read what was left there."""
        self._path = path
        self._reason = path.read_text(errors="replace") if path.exists() else ""

    @property
    def reason(self) -> str:
        """Why; empty where there is nothing."""
        return self._reason

    def engage(self, reason: str) -> None:
        """Latch; the first reason stays."""
        if not self._reason:
            self._reason = reason or "unknown"
            self._remember(self._reason)

    def release(self) -> str:
        """Take the reason away; return it."""
        reason, self._reason = self._reason, ""
        self._remember("")  # of another user's file this is all that may be done
        with suppress(OSError):
            self._path.unlink()
        return reason

    def _remember(self, reason: str) -> None:
        # Where that cannot be done, no room for instance, this process still knows.
        with suppress(OSError, RigError):
            fd = open_shared(self._path, 0)
            try:
                os.ftruncate(fd, 0)
                os.write(fd, reason.encode())
            finally:
                os.close(fd)
