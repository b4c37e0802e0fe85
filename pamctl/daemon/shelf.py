"""What the daemon keeps: its logs, and the fault that is not acknowledged yet."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hal.reservation import explain_shared_file, open_regular, open_shared
from hal.rig import RigError
from pamctl.base.errors import ExitCode
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.log.run_meta import flight_record_path, make_dated_path

_NAMING = threading.Lock()
"""Held from the choice of a log's name until the file exists: simulations may share a folder."""
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

    def __init__(
        self, directory: Path, keep: int | None = None, *, prefix: str = "daemon-"
    ) -> None:
        """Make the directory if there is none; with `keep` only the newest logs of daemons stay.

        The name of each log begins with `prefix`; without one, nobody indexes the logs.
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
        self._keep, self._prefix = keep, prefix

    @property
    def free_bytes(self) -> int:
        """Free space of the disk."""
        disk = os.statvfs(self.directory)
        return disk.f_bavail * disk.f_frsize

    @contextmanager
    def new_path(self, what: str) -> Iterator[Path]:
        """Give the path of the next log, which is there when the block ends."""
        with _NAMING:
            yield make_dated_path(self.directory, f"{self._prefix}{what}")

    def require_room(self, duration_s: float, rate_hz: float) -> None:
        """Raise `RequestRefusedError` where a run of this length would fill the disk."""
        ticks = min(duration_s, _UNBOUNDED_S) * rate_hz
        needed, free = round(ticks * _BYTES_PER_TICK) + _SPARE_BYTES, self.free_bytes
        if free < needed:
            raise RequestRefusedError(
                f"the disk of {self.directory} has {free >> 20} MiB left, this run may need "
                f"{needed >> 20}; make room, or shorten it with --duration"
            )

    def put_away(self, log: Path) -> str:
        """Index a log that is whole, and remove the oldest ones beyond those to keep.

        Flight records go with their logs. Logs with a tag stay, and so do logs of other runs.
        Return what could not be done; it is no reason to end the daemon.
        """
        if not self._prefix:
            return ""
        problems = []
        if self._keep is not None:
            found = self.directory.glob(f"[0-9]*-[0-9]*-{self._prefix}*.mcap")
            # By what is before the prefix: the second log of a second has a "-2" there.
            logs = sorted(found, key=lambda log: log.name.partition(f"-{self._prefix}")[0])
            for old in logs[: -self._keep]:
                try:
                    _remove_untagged(old)
                except OSError as error:
                    problems.append(f"{old} cannot be removed: {error.strerror or error}")
        return "; ".join(problems)


def _remove_untagged(log: Path) -> None:
    if not _has_tag(log):
        # First what lies beside it: without the log nothing would name it any more.
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


_LONGEST_BYTES = 4096


class Latch:
    """The reason of a fault, kept in shared memory until it is released, or until the next boot.

    A service manager may restart the daemon: the new one must still know why the muscle stands
    still.
    """

    def __init__(self, path: Path | None) -> None:
        """Read what was left there; raise `RigError` where that is no file of pamctl's.

        Without a path only this process knows: nothing moves when it has gone.
        """
        self._path = path
        self._reason = "" if path is None else _recall(path)

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
        if self._path is not None:
            with suppress(OSError):
                self._path.unlink()
        return reason

    def _remember(self, reason: str) -> None:
        if self._path is None:
            return
        # If writing fails, on a full disk for instance, this process still knows the reason.
        with suppress(OSError, RigError):
            fd = open_shared(self._path, 0)
            try:
                os.ftruncate(fd, 0)
                os.write(fd, reason.encode()[:_LONGEST_BYTES])
            finally:
                os.close(fd)


def _recall(path: Path) -> str:
    try:
        fd = open_regular(path, os.O_RDONLY, "all")
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise explain_shared_file(path, error) from error
    with os.fdopen(fd, "rb") as file:
        return file.read(_LONGEST_BYTES).decode(errors="replace")
