"""Keep freed memory in the process, for work that needs the same megabytes again and again."""

from __future__ import annotations

import contextlib
import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT_BYTES = 32 << 20


def keep_freed_memory() -> None:
    """Tell the C library to keep what is freed; do nothing where it is not glibc.

    Otherwise the kernel takes large blocks back at once and clears every page anew: two fifths of
    the time in which a chunk of a log is written or copied.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
