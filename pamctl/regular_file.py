"""What may be read as a file: what has an end, and does not wait for somebody to write."""

from __future__ import annotations

import stat
from pathlib import Path


def describe_irregular_file(path: Path) -> str:
    """Say what is there that is no file; nothing for a file, or where there is nothing.

    Ask before opening: a pipe waits for its other end then, and `/dev/zero` never ends.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # opening it says why better; ValueError: a NUL in the path
        return ""
    if stat.S_ISREG(mode):
        return ""
    if stat.S_ISDIR(mode):
        return "a directory, not a file"
    kind = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}.get(stat.S_IFMT(mode), "a device")
    return f"{kind}, not a file; copy what comes out of it into a file first"
