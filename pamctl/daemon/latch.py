"""The fault that is not acknowledged yet: it outlives the daemon.

A service manager that restarts a daemon must not make it forget why the muscle stands still.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


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

    def close_on(self, reason: str) -> None:
        """Latch; the first reason stays."""
        if not self._reason:
            self._reason = reason or "unknown"
            with suppress(OSError):  # no room to remember it beyond this process, which still does
                self._path.write_text(self._reason)

    def release(self) -> str:
        """Take the reason away; return it."""
        reason, self._reason = self._reason, ""
        self._path.unlink(missing_ok=True)
        return reason
