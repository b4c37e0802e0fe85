"""Marks for a run without a daemon: `pamctl mark TEXT` in a second terminal reaches its front.

The front listens on a socket without a file, which ends with the process however that ends. It
passes a mark on to the loop in the slot for orders, and never waits for anybody: it also watches
the loop. The mark stands in the log at the tick in which the loop took it.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from pamctl.exit_codes import ExitCode
from pamctl.plain_text import LONGEST_REMARK, clean_text
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.realtime.orders import Orders

_LARGEST_MESSAGE = 1 << 16
_MOST_CLIENTS = 8
_PATIENCE_S = 15.0
"""A loop that is just starting, on a busy PC, takes its first mark after some seconds."""
_CREDENTIALS = struct.Struct("3i")
_SOCKETS = Path("/proc/net/unix")


class MarkError(Exception):
    """A mark could not be put. The message says why."""

    exit_code = ExitCode.CHECK_FAILED


class RunningRun(NamedTuple):
    """A run of this user that takes marks."""

    address: str
    log: Path


def _prefix() -> str:
    # Runs with another shared memory do not see each other: tests, above all.
    place = hashlib.sha256(os.fsencode(SHARED_MEMORY)).hexdigest()[:12]
    return f"pamctl-run-{place}-"


class MarkDesk:
    """The front's side. Its `fd` goes to the loop, which takes marks from there."""

    def __init__(self, log: Path) -> None:
        """Listen; `log` is what clients choose a run by."""
        self._log = str(log.absolute())
        self._orders = Orders.create()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.setblocking(False)
        self._clients: list[socket.socket] = []
        self._waiting: socket.socket | None = None
        self._listener.bind(f"\0{_prefix()}{os.getpid()}-{time.monotonic_ns()}")
        self._listener.listen(_MOST_CLIENTS)

    @property
    def fd(self) -> int:
        """The descriptor of the slot for orders."""
        return self._orders.fd

    def look(self) -> None:
        """Take what clients have sent, and tell them what the loop has taken. Never waits."""
        if self._waiting is not None and self._orders.is_free:
            self._answer(self._waiting, {"marked": True})
            self._waiting = None
        with suppress(OSError):
            while len(self._clients) < _MOST_CLIENTS:
                client, _ = self._listener.accept()
                client.setblocking(False)
                self._clients.append(client)
        for client in list(self._clients):
            if client is not self._waiting:
                self._hear(client)

    def _hear(self, client: socket.socket) -> None:
        try:
            message = client.recv(_LARGEST_MESSAGE)
        except BlockingIOError:
            return
        except OSError:
            message = b""
        if not message or not _is_trusted(client):
            self._drop(client)
            return
        try:
            asked = json.loads(message)
            text = None if asked == {"ask": "log"} else clean_text(str(asked["mark"]))
        except (ValueError, KeyError, TypeError, RecursionError):
            self._drop(client)
            return
        if text is None:
            self._answer(client, {"log": self._log})
        elif not 1 <= len(text) <= LONGEST_REMARK:
            self._answer(client, {"refused": f"a mark has 1 to {LONGEST_REMARK} characters"})
        elif not self._orders.is_free:
            self._answer(client, {"refused": "the loop has not taken the mark before yet"})
        else:
            self._orders.send({"do": "mark", "text": text})
            self._waiting = client

    def _answer(self, client: socket.socket, answer: Mapping[str, object]) -> None:
        try:
            client.send(json.dumps(answer).encode())
        except OSError:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        if client in self._clients:
            self._clients.remove(client)
        client.close()

    def close(self) -> None:
        """Listen no more."""
        for client in list(self._clients):
            self._drop(client)
        self._listener.close()
        self._orders.close()


@contextmanager
def open_mark_desk(log: Path, *, wanted: bool) -> Iterator[MarkDesk | None]:
    """Take marks inside the block, where `wanted` and possible: a run does not fail for it."""
    desk = None
    if wanted:
        with suppress(OSError):
            desk = MarkDesk(log)
    try:
        yield desk
    finally:
        if desk is not None:
            desk.close()


def _is_trusted(client: socket.socket) -> bool:
    """Tell whether it is this user, or root."""
    raw = client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    _, user, _ = _CREDENTIALS.unpack(raw)
    return user in (0, os.geteuid())


def list_running_runs() -> list[RunningRun]:
    """Return the runs that this user may mark."""
    found = []
    for address in _list_addresses():
        with suppress(MarkError, KeyError):
            log = clean_text(str(_ask(address, {"ask": "log"})["log"]))
            found.append(RunningRun(address, Path(log)))
    return found


def mark_run(run: RunningRun, text: str) -> None:
    """Put a mark into the log of a run; return when the loop has taken it. Raise MarkError."""
    answer = _ask(run.address, {"mark": text})
    if "refused" in answer:
        raise MarkError(f"the run of {run.log} refused: {answer['refused']}")


def _list_addresses() -> list[str]:
    # A socket without a file stands in the kernel's list as `@name`.
    try:
        lines = _SOCKETS.read_text(errors="replace").splitlines()
    except OSError:  # hidden from this user
        return []
    names = {line.rpartition(" ")[2] for line in lines}
    return sorted(name[1:] for name in names if name.startswith(f"@{_prefix()}"))


def _ask(address: str, message: Mapping[str, object]) -> dict[str, Any]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.settimeout(_PATIENCE_S)
        try:
            client.connect(f"\0{address}")
            client.send(json.dumps(message).encode())
            answer = client.recv(_LARGEST_MESSAGE)
        except OSError as error:
            raise MarkError(f"the run does not answer: {error.strerror or error}") from error
    try:  # no answer: the run has another user, or has just ended
        said: dict[str, Any] = dict(json.loads(answer))
    except (ValueError, TypeError):
        raise MarkError("the run takes no marks from this user, or has just ended") from None
    return said
