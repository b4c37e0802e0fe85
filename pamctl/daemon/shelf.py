"""The daemon's logs: their names, the room they need on the disk, and how many are kept."""

from __future__ import annotations

import os
from pathlib import Path

from pamctl.daemon.protocol import RequestRefusedError
from pamctl.exit_codes import ExitCode
from pamctl.log.run_meta import flight_record_path, make_dated_path

_DAEMON_PREFIX = "daemon"
_BYTES_PER_TICK = 300
"""Some 200 are usual; this leaves a margin."""
_SPARE_BYTES = 100 << 20
_UNBOUNDED_S = 600.0
"""A held position has no end: this is the time for which there must be room at its start (s)."""


class ShelfError(Exception):
    """Logs cannot be written there. The message says why."""

    exit_code = ExitCode.USAGE


class Shelf:
    """A directory of logs."""

    def __init__(self, directory: Path, keep: int | None = None) -> None:
        """Make the directory if there is none; with `keep` only the newest logs of daemons stay.

        Raises `ShelfError` where nothing can be written there.
        """
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ShelfError(f"--logs {directory}: {error.strerror or error}") from error
        if not os.access(directory, os.W_OK | os.X_OK):
            raise ShelfError(f"--logs {directory}: cannot write into {directory}")
        self.directory = directory.resolve()
        """The directory, from the root."""
        self._keep = keep

    @property
    def free_bytes(self) -> int:
        """Free space of the disk."""
        disk = os.statvfs(self.directory)
        return disk.f_bavail * disk.f_frsize

    def new_path(self, what: str) -> Path:
        """Return the path of the next log; its name says that it is the daemon's."""
        return make_dated_path(self.directory, f"{_DAEMON_PREFIX}-{what}")

    def require_room(self, duration_s: float, rate_hz: float) -> None:
        """Raise `RequestRefusedError` where a run of this length would fill the disk."""
        ticks = min(duration_s, _UNBOUNDED_S) * rate_hz
        needed, free = round(ticks * _BYTES_PER_TICK) + _SPARE_BYTES, self.free_bytes
        if free < needed:
            raise RequestRefusedError(
                f"the disk of {self.directory} has {free >> 20} MiB left, this run may need "
                f"{needed >> 20}; make room, or shorten it with --duration"
            )

    def tidy(self) -> None:
        """Remove the daemon's oldest logs beyond those to keep, with their flight records.

        Logs with a tag stay, and so do logs of other runs in the same directory.
        """
        if self._keep is None:
            return
        logs = sorted(self.directory.glob(f"[0-9]*-[0-9]*-{_DAEMON_PREFIX}-*.mcap"))
        for log in logs[: -self._keep]:
            if _has_tag(log):
                continue
            # First what lies beside the log: without the log nothing would name it any more.
            flight_record_path(log).unlink(missing_ok=True)
            log.unlink(missing_ok=True)


def _has_tag(log: Path) -> bool:
    """Tell whether somebody has tagged the log; a damaged one says what stands before its end."""
    # Not at the top: a daemon that keeps all its logs needs no memory for this.
    from pamctl.log.edit import read_annotation
    from pamctl.log.framing import LogError

    try:
        return bool(read_annotation(log).tags)
    except LogError:
        return False
