"""Who holds a device: a lock that dies with its owner, even by SIGKILL.

The kernel drops a `flock` when the last descriptor of its owner goes, so there is nothing
to clean up after a crash and no stale lock file to explain. The file itself stays, and
carries the owner's process id for the one who is refused.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hal.rig import RigError

_PID = "20d"


def open_shared(path: Path, size: int) -> int:
    """Open a file of at least `size` bytes, zeros at first, that any user of this PC may hold.

    Raises `RigError` where that is not possible.
    """
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        try:
            # Without O_CREAT: the kernel refuses that on a file of another user in /dev/shm.
            fd = os.open(path, flags)
        except FileNotFoundError:
            fd = os.open(path, flags | os.O_CREAT, 0o666)
            os.fchmod(fd, 0o666)  # whatever the umask: one PC, one rig, several users
        if os.fstat(fd).st_size < size:
            os.ftruncate(fd, size)
    except OSError as error:
        raise RigError(f"cannot open {path}: {error.strerror}", fix="check who owns it") from error
    return fd


def reserve(fd: int, what: str, pid_at: int = 0) -> None:
    """Hold `what` until `fd` is closed or this process dies; raise `RigError` if another does.

    `pid_at` is where in the file the owner's process id stands.
    """
    import fcntl  # not on every system where a log is replayed, and a rig file is read

    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(fd, len(format(0, _PID)), pid_at).decode(errors="replace").strip("\0 ")
        raise RigError(
            f"{what} is held by process {holder or '(unknown)'}",
            fix="wait for it to end; or end it, a daemon's session with `pamctl disarm` or "
            f"`pamctl estop`, a run with Ctrl-C{f' or kill {holder}' if holder else ''}",
        ) from None
    os.pwrite(fd, format(os.getpid(), _PID).encode(), pid_at)


@contextmanager
def hold_reservation(path: Path, what: str) -> Iterator[None]:
    """Hold `what` within the block; raise `RigError` if another process does."""
    fd = open_shared(path, 0)
    try:
        reserve(fd, what)
        yield
    finally:
        os.close(fd)
