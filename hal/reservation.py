"""Files in shared memory, and who holds a device: a lock that ends with its owner, even by SIGKILL.

Everybody on the PC may put files there. So every one is opened here: never through a link, never
waiting for anybody, and only a regular file that pamctl may have made.

The kernel drops a `flock` when the last descriptor of its owner is closed, so a crash leaves no
stale lock. The file itself stays; it carries the owner's process id for the message to others.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from hal.rig import RigError

_PID = "20d"
_OF_ALL_USERS = 0o666


def open_regular(path: Path, flags: int, owner: Literal["me", "all", "any"]) -> int:
    """Open a file in shared memory; raise OSError for a link, a pipe, or a wrong owner's file.

    `owner` says whose it may be: only this user's; also one that all users may write, as pamctl
    makes them where one rig has several users; or anybody's.
    """
    # Without O_NONBLOCK a pipe would wait for its other end.
    flags |= os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        fd = os.open(path, flags, _OF_ALL_USERS)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise OSError(errno.ELOOP, "it is a link", str(path)) from None
    found = os.fstat(fd)
    is_right = owner == "any" or found.st_uid == os.geteuid()
    if owner == "all":
        is_right |= stat.S_IMODE(found.st_mode) == _OF_ALL_USERS
    if stat.S_ISREG(found.st_mode) and is_right:
        return fd
    os.close(fd)
    problem = "it is another user's own" if not is_right else "it is not a regular file"
    raise OSError(errno.EPERM, problem, str(path))


def open_shared(path: Path, size: int) -> int:
    """Open a file of at least `size` bytes (zeros at first) that every user of this PC may lock.

    The bytes are there even if shared memory is full later.

    Raises `RigError` where this is not possible.
    """
    try:
        try:
            # Without O_CREAT: the kernel refuses that on a file of another user in /dev/shm.
            fd = open_regular(path, os.O_RDWR, "all")
        except FileNotFoundError:
            fd = open_regular(path, os.O_RDWR | os.O_CREAT, "all")
            os.fchmod(fd, _OF_ALL_USERS)  # whatever the umask
        try:
            if size:
                os.posix_fallocate(fd, 0, size)
        except OSError:
            os.close(fd)
            raise
    except OSError as error:
        raise explain_shared_file(path, error) from error
    return fd


def explain_shared_file(path: Path, error: OSError) -> RigError:
    """Return the error for the user where a file in shared memory cannot be used."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        fix = f"remove what fills {path.parent}"
    else:
        fix = f"see who made it with `ls -l {path}`, and remove it"
    return RigError(f"cannot use {path}: {error.strerror}", fix=fix)


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
    with suppress(OSError):  # shared memory is full: the lock holds without its owner's name
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
