"""The fault that is not acknowledged yet. It outlives the daemon.

A service manager may restart the daemon: the new one must still know why the muscle stands still.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from hal.reservation import explain_shared_file, open_regular, open_shared
from hal.rig import RigError

_LONGEST_BYTES = 4096


class Latch:
    """The reason of a fault, kept in shared memory until it is released, or until the next boot."""

    def __init__(self, path: Path) -> None:
        """Read what was left there; raise `RigError` where that is no file of pamctl's."""
        self._path = path
        self._reason = self._recall()

    @property
    def reason(self) -> str:
        """The reason; empty where nothing is latched."""
        return self._reason

    def engage(self, reason: str) -> None:
        """Latch the reason; the first one stays."""
        if not self._reason:
            self._reason = reason or "unknown"
            self._remember(self._reason)

    def release(self) -> str:
        """Release the latch; return the reason."""
        reason, self._reason = self._reason, ""
        self._remember("")  # a file of another user can be emptied, not removed
        with suppress(OSError):
            self._path.unlink()
        return reason

    def _recall(self) -> str:
        try:
            fd = open_regular(self._path, os.O_RDONLY, "all")
        except FileNotFoundError:
            return ""
        except OSError as error:
            raise explain_shared_file(self._path, error) from error
        with os.fdopen(fd, "rb") as file:
            return file.read(_LONGEST_BYTES).decode(errors="replace")

    def _remember(self, reason: str) -> None:
        # If writing fails, on a full disk for instance, this process still knows the reason.
        with suppress(OSError, RigError):
            fd = open_shared(self._path, 0)
            try:
                os.ftruncate(fd, 0)
                os.write(fd, reason.encode()[:_LONGEST_BYTES])
            finally:
                os.close(fd)
