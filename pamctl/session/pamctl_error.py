"""The one error of a session: what a verb of the shell would print, and its exit code."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from hal.child import advise_install
from pamctl.base.errors import ExitCode

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""What a package or a cache may meet that does not write through `pamctl.base.new_file`."""

_NO_MORE_FILES = {errno.EMFILE, errno.ENFILE}


class PamctlError(Exception):
    """What went wrong, where, and what to do. `str(error)` is the line that the shell prints."""

    def __init__(self, reason: str, exit_code: ExitCode, log: Path | None = None) -> None:
        """`log` is the record of a run that ended early; it is whole."""
        super().__init__(reason)
        self.reason = reason
        self.exit_code = exit_code
        self.log = log

    @property
    def fix(self) -> str:
        """What to do about it: the advice after the first semicolon; empty where there is none."""
        return self.reason.partition("; ")[2]


def explain_error(error: Exception) -> tuple[ExitCode, str] | None:
    """Return exit code and line for an error that a user can cause; None for all others."""
    code = getattr(error, "exit_code", None)
    if isinstance(code, ExitCode):
        return code, str(error)
    rig = sys.modules.get("hal.rig")  # no help waits for the models that it loads
    if rig is not None and isinstance(error, rig.RigError):
        return ExitCode.UNAVAILABLE, str(error)
    if isinstance(error, OSError) and error.errno in _NO_MORE_FILES:
        return ExitCode.UNAVAILABLE, f"{error.strerror}; raise the limit with `ulimit -n 4096`"
    if isinstance(error, OSError) and error.errno in _NO_ROOM:
        reason = f"cannot write {error.filename or 'a file'}: {error.strerror}; make room there"
        return ExitCode.UNEXPECTED, reason
    return None


@contextmanager
def translate_errors() -> Iterator[None]:
    """Raise `PamctlError` for every error that a user can cause."""
    try:
        yield
    except PamctlError:
        raise
    except Exception as error:
        known = explain_error(error)
        if known is None:
            raise
        raise PamctlError(known[1], known[0]) from error


def require_package(name: str) -> Any:
    """Return a package that not everybody needs; raise `PamctlError` where it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        reason = f"this needs the package {name}; {advise_install(name)}"
        raise PamctlError(reason, ExitCode.USAGE) from None
