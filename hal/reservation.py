"""Who holds a device: a lock that ends with its owner, even by SIGKILL.

The kernel drops a `flock` when the last descriptor of its owner is closed, so a crash leaves no
stale lock. The file itself stays; it carries the owner's process id for the message to others.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hal.rig import RigError

_PID = "20d"


def open_shared(path: Path, size: int) -> int:
    """Open a file of at least `size` bytes (zeros at first) that every user of this PC may lock.

    Raises `RigError` where this is not possible.
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
    import fcntl  # replay works on systems that have none

    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(fd, len(format(0, _PID)), pid_at).decode(errors="replace").strip("\0 ")
        raise RigError(
            f"{what} is held by process {holder or '(unknown)'}",
            fix="wait for it to end; or end it: a run or a daemon with Ctrl-C in its terminal"
            f"{f', or `kill {holder}`' if holder else ''}",
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
