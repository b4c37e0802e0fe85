"""Refuse to read anything but regular files: others may never end, or wait for a writer."""

from __future__ import annotations

import stat
from pathlib import Path


def describe_irregular_file(path: Path) -> str:
    """Describe a path that is not a regular file; empty for regular and missing files.

    Call it before opening: opening a pipe waits for its other end, and `/dev/zero` never ends.
    """
    try:
        mode = path.stat().st_mode
    except (
        OSError,
        ValueError,
    ):  # opening it gives a better message; ValueError: a NUL in the path
        return ""
    if stat.S_ISREG(mode):
        return ""
    if stat.S_ISDIR(mode):
        return "a directory, not a file"
    kind = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}.get(stat.S_IFMT(mode), "a device")
    return f"{kind}, not a file; copy its content into a file first"
