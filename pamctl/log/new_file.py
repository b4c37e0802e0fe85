"""A file that did not exist before, and exists afterwards only if it is whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path

from pamctl.exit_codes import ExitCode
from pamctl.log.framing import LogError


class NewFileError(LogError):
    """The file to be written cannot be: it exists, or its place does not."""

    exit_code = ExitCode.USAGE


@contextmanager
def create_new_file(path: Path) -> Iterator[BufferedWriter]:
    """Open a file that must not exist; on an error leave none behind.

    Raise NewFileError if there is one, or none can be made. When the block ends well, the file
    is on the disk.
    """
    try:
        stream = path.open("xb")
    except FileExistsError:
        raise NewFileError(f"{path} exists, and is never overwritten; give another name") from None
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
