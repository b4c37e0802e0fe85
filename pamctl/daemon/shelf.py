"""Where the daemon's logs stand: a name for each, room for the next, and how many are kept."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from pamctl.daemon.refusal import Refused
from pamctl.log.naming import dated_name

_BYTES_PER_TICK = 300
"""Some 200 are usual."""
_SPARE_BYTES = 100 << 20
_UNBOUNDED_S = 600.0
"""A position that is held has no end; room for so long must be there when it begins."""


class Shelf:
    """A directory of logs."""

    def __init__(self, directory: Path, keep: int | None = None) -> None:
        """Make the directory if need be; with `keep` only the newest logs stay.

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
        """Return the name of the next log."""
        return dated_name(self._directory, what)

    def require_room(self, duration_s: float, rate_hz: float) -> None:
        """Raise `Refused` where a run of this length would fill the disk."""
        ticks = min(duration_s, _UNBOUNDED_S) * rate_hz
        needed, free = round(ticks * _BYTES_PER_TICK) + _SPARE_BYTES, self.free_bytes
        if free < needed:
            raise Refused(
                f"the disk of {self._directory} has {free >> 20} MiB left, this run may need "
                f"{needed >> 20}; make room, or shorten it with --duration"
            )

    def tidy(self, spare: Iterable[Path]) -> list[Path]:
        """Remove the oldest logs beyond those to keep, never one of `spare`; return them."""
        if self._keep is None:
            return []
        untouchable = {path.resolve() for path in spare}
        logs = sorted(self._directory.glob("[0-9]*-[0-9]*-*.mcap"))
        old = [path for path in logs[: -self._keep] if path not in untouchable]
        for path in old:
            path.unlink(missing_ok=True)
        return old
