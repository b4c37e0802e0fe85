"""A client of the control socket: one request, one answer."""

from __future__ import annotations

import json
import math
import os
import socket
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pamctl.base.errors import ExitCode
from pamctl.base.texts import clean_document

_PATIENCE_S = 60.0
"""Starting a session may take a driver several seconds."""


class DaemonUnreachableError(Exception):
    """No daemon can be reached. The message says what to do."""

    exit_code = ExitCode.UNAVAILABLE


class DaemonDeclinedError(Exception):
    """The daemon refused; the message is its own, the code is that of the protocol."""

    exit_code = ExitCode.CHECK_FAILED

    def __init__(self, message: str, code: int) -> None:
        """`code` is one of `pamctl.daemon.protocol`."""
        super().__init__(message)
        self.code = code


_SYSTEM_SOCKET = Path("/run/pamctl/control.sock")


def own_socket() -> Path:
    """Return where a daemon of this user listens; root's is the system's."""
    if os.geteuid() == 0:
        return _SYSTEM_SOCKET
    return Path(os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}") / "pamctl.sock"


def default_socket() -> Path:
    """Return where a client looks for a daemon: this user's own, or else the system's."""
    own = own_socket()
    return own if own.exists() or not _SYSTEM_SOCKET.exists() else _SYSTEM_SOCKET


class Client:
    """A connection to the daemon; a context manager."""

    def __init__(self, path: Path, patience_s: float = _PATIENCE_S) -> None:
        """Connect; wait for an answer for `patience_s` at most.

        Raises `DaemonUnreachableError`.
        """
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        # A socket with a timeout of Python's would not wait while many others connect.
        most = struct.pack("@ll", *divmod(round(patience_s * 1e6), 1_000_000))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, most)
        try:
            self._socket.connect(str(path))
            self._socket.settimeout(patience_s)
        except OSError as error:
            self._socket.close()
            raise DaemonUnreachableError(_advice(path, error)) from error
        self._answers = self._socket.makefile("rb")
        self._last_id = 0

    def call(self, method: str, params: Mapping[str, object] | None = None) -> Any:
        """Send a request and return the answer.

        Raises `DaemonDeclinedError`, or `DaemonUnreachableError` if the connection is lost.
        """
        self._last_id += 1
        request = {"jsonrpc": "2.0", "id": self._last_id, "method": method, "params": params or {}}
        try:
            self._socket.sendall(json.dumps(request).encode() + b"\n")
            line = self._answers.readline()
        except OSError as error:
            raise DaemonUnreachableError(f"the daemon does not answer: {error}") from error
        if not line:
            raise DaemonUnreachableError("the daemon closed the connection")
        answer = clean_document(json.loads(line))
        if "error" in answer:
            raise DaemonDeclinedError(answer["error"]["message"], answer["error"]["code"])
        return answer["result"]

    def close(self) -> None:
        """Hang up."""
        self._answers.close()
        self._socket.close()

    def __enter__(self) -> Client:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Hang up."""
        self.close()


def read_ticks(answer: Mapping[str, Any]) -> list[dict[str, float]]:
    """Return the ticks in an answer to `recent`: columns by name, oldest first."""
    return [restore_nan(dict(zip(answer["fields"], row, strict=True))) for row in answer["ticks"]]


def restore_nan(tick: Mapping[str, float | None]) -> dict[str, float]:
    """Return a tick as the loop has it: NaN where a value is unknown, as JSON knows no NaN."""
    return {name: math.nan if value is None else value for name, value in tick.items()}


def _advice(path: Path, error: OSError) -> str:
    if isinstance(error, PermissionError):
        return f"{path}: not permitted; join the group of the socket"
    if isinstance(error, FileNotFoundError | ConnectionRefusedError):
        return f"{path}: no daemon listens there; start one with `pamctl daemon`, or give --socket"
    return f"{path}: {error.strerror or error}"
