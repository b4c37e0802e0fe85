"""Where the daemon's logs stand: a name for each, room for the next, and how many are kept."""

from __future__ import annotations

import os
from pathlib import Path

from pamctl.daemon.refusal import RequestRefusedError
from pamctl.log.naming import flight_record_path, make_dated_path

_DAEMON_PREFIX = "daemon"
_BYTES_PER_TICK = 300
"""Some 200 are usual."""
_SPARE_BYTES = 100 << 20
_UNBOUNDED_S = 600.0
"""A position that is held has no end; room for so long must be there when it begins."""


class Shelf:
    """A directory of logs."""

    def __init__(self, directory: Path, keep: int | None = None) -> None:
        """Make the directory if need be; with `keep` only the newest logs of daemons stay.

        Raises `OSError` where nothing can be written there.
        """
        directory.mkdir(parents=True, exist_ok=True)
        if not os.access(directory, os.W_OK | os.X_OK):
            raise PermissionError(f"cannot write into {directory}")
        self._directory = directory.resolve()
        self._keep = keep

    @property
    def free_bytes(self) -> int:
        """Room left on the disk."""
        disk = os.statvfs(self._directory)
        return disk.f_bavail * disk.f_frsize

    def new_path(self, what: str) -> Path:
        """Return the name of the next log, by which it is known for the daemon's."""
        return make_dated_path(self._directory, f"{_DAEMON_PREFIX}-{what}")

    def require_room(self, duration_s: float, rate_hz: float) -> None:
        """Raise `RequestRefusedError` where a run of this length would fill the disk."""
        ticks = min(duration_s, _UNBOUNDED_S) * rate_hz
        needed, free = round(ticks * _BYTES_PER_TICK) + _SPARE_BYTES, self.free_bytes
        if free < needed:
            raise RequestRefusedError(
                f"the disk of {self._directory} has {free >> 20} MiB left, this run may need "
                f"{needed >> 20}; make room, or shorten it with --duration"
            )

    def tidy(self) -> None:
        """Remove the daemon's oldest logs beyond those to keep, with what lies beside them.

        Logs of others are in the same directory where nobody says otherwise.
        """
        if self._keep is None:
            return
        logs = sorted(self._directory.glob(f"[0-9]*-[0-9]*-{_DAEMON_PREFIX}-*.mcap"))
        for log in logs[: -self._keep]:
            flight_record_path(log).unlink(
                missing_ok=True
            )  # first: without its log nobody finds it
            log.unlink(missing_ok=True)
