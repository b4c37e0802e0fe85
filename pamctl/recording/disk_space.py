"""Reserve disk space ahead, so that a full disk costs no row of the log.

Blocks after the end of the file are allocated before they are needed. When the disk is full,
there is still room for all rows in the ring, the index and the footer.
"""

from __future__ import annotations

import ctypes
import errno
import os

STEP_BYTES = 4 << 20

# The summary has an index entry for each chunk, and everything else.
_SUMMARY_BYTES = 64 << 10
_SUMMARY_BYTES_PER_CHUNK = 256
_FALLOC_FL_KEEP_SIZE = 1
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_UNSUPPORTED = (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)


def is_full(error: OSError) -> bool:
    """Tell whether an error means that the disk, the quota or the file size limit is reached."""
    return error.errno in _FULL


class Reserve:
    """Reserved space after the end of one file."""

    def __init__(self, fd: int, backlog_bytes: int) -> None:
        """`backlog_bytes` is the most that may still have to be written at any time."""
        self._fd = fd
        self._backlog = backlog_bytes
        self._end = 0
        self.supported = True
        """Whether this file system can reserve space; if not, its free space is watched."""

    def extend(self, position: int, chunks: int) -> None:
        """Reserve space after `position`; raise OSError if the disk is full."""
        needed = position + self._backlog + _SUMMARY_BYTES + chunks * _SUMMARY_BYTES_PER_CHUNK
        if needed > self._end:
            self._allocate(self._end, needed + STEP_BYTES)

    def release(self, position: int) -> None:
        """Return the space after the end of the finished file."""
        os.ftruncate(self._fd, position)

    def _allocate(self, start: int, end: int) -> None:
        import resource  # other systems have none, and reserve nothing

        limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        if limit != resource.RLIM_INFINITY and end > limit:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        if self.supported:
            try:
                _fallocate(self._fd, start, end - start)
            except OSError as error:
                if error.errno not in _UNSUPPORTED:
                    raise
                self.supported = False
        if not self.supported:
            self._require_free(end - start)
        self._end = end

    def _require_free(self, size: int) -> None:
        disk = os.fstatvfs(self._fd)
        if disk.f_bavail * disk.f_frsize < size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _fallocate(fd: int, start: int, size: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    allocate = getattr(libc, "fallocate64", None) or libc.fallocate
    allocate.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)
    while allocate(fd, _FALLOC_FL_KEEP_SIZE, start, size) != 0:
        code = ctypes.get_errno()
        if code != errno.EINTR:
            raise OSError(code, os.strerror(code))
