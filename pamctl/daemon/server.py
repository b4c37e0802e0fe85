"""The control socket: many clients, none of which can disturb the others or the loop.

The socket has mode 0660: its group may steer. What a client sends is limited in size. A client
that does not read its answers is disconnected. Clients wait for each other, and together take at
most half of the time. An emergency stop waits for nobody; whoever has asked for one waits before
the next line.
"""

from __future__ import annotations

import asyncio
import grp
import os
import socket
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from pamctl.base.errors import ExitCode
from pamctl.daemon.protocol import (
    INTERNAL_ERROR,
    INVALID_REQUEST,
    LARGEST_REQUEST,
    REFUSED,
    TOO_MANY,
    OrderTaker,
    Request,
    RequestError,
    RequestRefusedError,
    encode_failure,
    encode_result,
    list_orders,
    parse_request,
)

MOST_CLIENTS = 256
"""Whoever comes then may only stop."""
_ACCEPTED_AT_ONCE = 8
_MOST_UNACCEPTED = 64
_READS_WITHIN_S = 2.0
_MOST_UNREAD_BYTES = 1 << 20
_LONGEST_EMERGENCY = 1024
"""Bytes of a line that may be an emergency stop: only a short one is parsed out of turn."""
_SHORTEST_PAUSE_S = 1e-3
_STEPS_OF_A_WELCOME = 4
"""Rounds of the event loop from a client's connection to its first line: see, accept, attach."""

_NO_LINE = (asyncio.IncompleteReadError, asyncio.LimitOverrunError)


class Turns:
    """Clients wait here for each other, and together take at most half of the time.

    No rate is limited beside this. The watch over the loop shares the interpreter: however much is
    asked, it finds every other moment free.
    """

    def __init__(self) -> None:
        """Begin with nobody waiting."""
        self._lock = asyncio.Lock()  # first come, first served
        self._debt_s = 0.0

    @asynccontextmanager
    async def take_turn(self, spent_s: float = 0.0) -> AsyncIterator[None]:
        """Wait for a turn; after it, nobody has one for as long as it took.

        Short turns are added up: no sleep is shorter than a millisecond. `spent_s` is time that
        the client took out of turn, before this one.
        """
        async with self._lock:
            began_s = time.monotonic() - spent_s
            try:
                yield
            finally:
                self._debt_s += time.monotonic() - began_s
                pause_s = self._debt_s if self._debt_s > _SHORTEST_PAUSE_S else 0.0
                self._debt_s -= pause_s
                await asyncio.sleep(pause_s)


class SocketError(Exception):
    """The control socket cannot be made. The message says why, and what to do."""

    exit_code = ExitCode.UNAVAILABLE


class Server:
    """Answers requests on a Unix socket."""

    def __init__(self, taker: OrderTaker) -> None:
        """Give orders to `taker`; none may end the process."""
        self._taker, self._orders = taker, list_orders(type(taker))
        self._at_once = {name.encode() for name, told in self._orders.items() if told.at_once}
        self._clients = 0
        self._turns = Turns()
        # One after the other in one thread: each further thread would keep memory of its own.
        self._worker = ThreadPoolExecutor(1, "orders")

    async def listen(self, path: Path, group: str | None = None) -> None:
        """Make the socket and answer from now on; raise `SocketError`."""
        bound = _bind_socket(path, group)
        self._path = path
        # Accepting many clients at once would keep the others waiting.
        self._listening = await asyncio.start_unix_server(
            self._welcome, sock=bound, limit=LARGEST_REQUEST, backlog=_ACCEPTED_AT_ONCE
        )
        bound.listen(_MOST_UNACCEPTED)

    async def close(self) -> None:
        """Take no more clients and remove the socket; those connected are still answered."""
        self._path.unlink(missing_ok=True)
        # A client may be accepted and not yet served. asyncio forgets such clients when it
        # closes, and they would wait for an answer as long as this process lives.
        for _ in range(_STEPS_OF_A_WELCOME):
            await asyncio.sleep(0)
        self._listening.close()

    async def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients += 1
        serve = self._serve if self._clients <= MOST_CLIENTS else self._serve_emergency
        try:
            await serve(reader, writer)
        except (ConnectionError, TimeoutError, *_NO_LINE):
            pass  # it went, or does not read
        except asyncio.CancelledError:
            pass  # the daemon ends
        finally:
            self._clients -= 1
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.transport.set_write_buffer_limits(high=_MOST_UNREAD_BYTES)
        while True:
            try:
                line = await reader.readuntil()
            except asyncio.LimitOverrunError:
                message = f"a request is one line of at most {LARGEST_REQUEST} bytes"
                writer.write(encode_failure(RequestError(INVALID_REQUEST, message)))
                await _drain_writer(writer)
                return
            began_s = time.monotonic()
            stopped = self._stop_if_asked(line)
            writer.write(await self._answer(line) if stopped is None else stopped)
            if stopped is not None:
                # The next line of this client waits, also where it is another emergency stop.
                async with self._turns.take_turn(time.monotonic() - began_s):
                    pass
            await _drain_writer(writer)

    async def _serve_emergency(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Read one line; do nothing but stop."""
        async with asyncio.timeout(_READS_WITHIN_S):
            line = await reader.readuntil()
        busy = RequestError(TOO_MANY, f"{MOST_CLIENTS} clients are connected; close some")
        writer.write(self._stop_if_asked(line) or encode_failure(busy))
        await _drain_writer(writer)

    def _stop_if_asked(self, line: bytes) -> bytes | None:
        """Carry out an emergency stop and return its answer; None where the line is none.

        It is granted after any number of requests.
        """
        if len(line) > _LONGEST_EMERGENCY or not any(name in line for name in self._at_once):
            return None
        try:
            request = parse_request(line, self._orders)
            if not request.order.at_once:
                return None
        except RequestError:
            return None
        try:
            return encode_result(request.id, self._carry_out(request))
        except RequestError as error:
            return encode_failure(error)

    async def _answer(self, line: bytes) -> bytes:
        try:
            async with self._turns.take_turn():
                request = parse_request(line, self._orders)
                if not request.order.changes:
                    return encode_result(request.id, self._carry_out(request))
            events = asyncio.get_running_loop()
            result = await events.run_in_executor(self._worker, self._carry_out, request)
            return encode_result(request.id, result)
        except RequestError as error:
            return encode_failure(error)

    def _carry_out(self, request: Request) -> object:
        try:
            return request.order.carry_out(self._taker, request.params)
        except RequestRefusedError as error:
            raise RequestError(REFUSED, str(error), request.id) from error
        except Exception as error:  # our own fault: report it to the client, and continue
            message = f"{type(error).__name__}: {error}"
            raise RequestError(INTERNAL_ERROR, message, request.id) from error


async def _drain_writer(writer: asyncio.StreamWriter) -> None:
    async with asyncio.timeout(_READS_WITHIN_S):
        await writer.drain()


def find_group(group: str | None) -> int:
    """Return the number of the group that may steer; raise `SocketError` if there is no such."""
    try:
        return os.getegid() if group is None else grp.getgrnam(group).gr_gid
    except KeyError:
        raise SocketError(f"--group {group}: there is no such group") from None


def _bind_socket(path: Path, group: str | None) -> socket.socket:
    """Make the socket; replace an old one that nobody answers any more."""
    owners = find_group(group)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            _require_stale(path)
            path.unlink()
        return _make_socket(path, owners)
    except OSError as error:
        raise SocketError(
            f"{path}: the control socket cannot be made: {error.strerror or error}; "
            "give another place with --socket"
        ) from error


def _make_socket(path: Path, owners: int) -> socket.socket:
    """Bind a socket that only this user and the group `owners` can use, from the start."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o117)
    try:
        listening.bind(str(path))
    finally:
        os.umask(before)
    try:
        os.chown(path, -1, owners)
    except OSError:
        path.unlink()
        raise
    return listening


def require_no_daemon(path: Path) -> None:
    """Raise `SocketError` if a daemon answers at a socket, or something else lies there."""
    if path.exists():
        _require_stale(path)


def _require_stale(path: Path) -> None:
    if not path.is_socket():  # a file of somebody: it must not be lost
        raise SocketError(f"{path}: there is something else; give another place with --socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        with suppress(ConnectionRefusedError, FileNotFoundError):
            probe.connect(str(path))
            raise SocketError(
                f"{path}: a daemon answers there already; ask it with `pamctl status`, end it "
                "with Ctrl-C in its terminal, or give another place with --socket"
            )
