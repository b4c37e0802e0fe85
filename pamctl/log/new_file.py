"""Create a new file that stays only if it was written completely."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path

from pamctl.exit_codes import ExitCode
from pamctl.log.framing import LogError


class NewFileError(LogError):
    """The file cannot be created: it exists, or its folder does not."""

    exit_code = ExitCode.USAGE


@contextmanager
def create_new_file(path: Path) -> Iterator[BufferedWriter]:
    """Open a file that must not exist; remove it if the block fails.

    Raise NewFileError if the file exists or cannot be created. When the block ends well, the
    file is on the disk.
    """
    try:
        stream = path.open("xb")
    except FileExistsError:
        raise NewFileError(f"{path} exists and is never overwritten; give another name") from None
    except OSError as error:
        raise NewFileError(f"cannot create {path}: {error.strerror}") from error
    try:
        with stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
    except BaseException:
        path.unlink()
        raise
