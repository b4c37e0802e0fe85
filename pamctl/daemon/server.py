"""The control socket: many clients, none of which can disturb the others or the loop.

The socket has mode 0660: its group may steer. What a client sends is limited in size and
rate. A client that does not read its answers is disconnected. Clients wait for each other.
An emergency stop waits for nobody; whoever has asked for one waits before the next line.
"""

from __future__ import annotations

import asyncio
import grp
import os
import select
import socket
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from pamctl.daemon.protocol import (
    INTERNAL_ERROR,
    INVALID_REQUEST,
    LARGEST_REQUEST,
    REFUSED,
    TOO_MANY,
    Method,
    Request,
    RequestError,
    RequestRefusedError,
    encode_failure,
    encode_result,
    parse_request,
)
from pamctl.exit_codes import ExitCode

MOST_CLIENTS = 64
_MOST_WAITING = 256
"""As many are served where all of them wait for an answer; whoever comes then may only stop."""
_ACCEPTED_AT_ONCE = 8
_MOST_UNACCEPTED = 64
_READS_WITHIN_S = 2.0
_MOST_UNREAD_BYTES = 1 << 20
_LONGEST_EMERGENCY = 1024
"""Bytes of a line that may be an emergency stop: only a short one is parsed out of turn."""
_READ_BYTES = 1 << 16
_SHORTEST_PAUSE_S = 1e-3
_STEPS_OF_A_WELCOME = 4
"""Rounds of the event loop from a client's connection to its first line: see, accept, attach."""

REQUESTS_PER_S = 100.0
BURST = 200.0
BYTES_PER_REQUEST = 4096
"""A longer line counts as several requests."""

_NO_LINE = (asyncio.IncompleteReadError, asyncio.LimitOverrunError)

Methods = dict[str, Method]


class Allowance:
    """The requests that a client may still make: a bucket that fills with time."""

    def __init__(self, now_s: float) -> None:
        """Begin with a full bucket."""
        self._tokens, self._last_s = BURST, now_s

    def spend(self, now_s: float, size: int = 1) -> bool:
        """Take the tokens for a line of `size` bytes; return whether there were enough."""
        self._tokens = min(BURST, self._tokens + (now_s - self._last_s) * REQUESTS_PER_S)
        self._last_s = now_s
        tokens = max(1.0, size / BYTES_PER_REQUEST)
        if self._tokens < tokens:
            return False
        self._tokens -= tokens
        return True


class Turns:
    """Clients wait here for each other, and together take at most half of the time.

    The watch over the loop shares the interpreter: however much is asked, it finds every other
    moment free.
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


class _LineReader(asyncio.StreamReader):
    """Reads no further while it holds a line: what a client sends ahead costs no time."""

    def __init__(self) -> None:
        super().__init__(LARGEST_REQUEST)
        self._lines = 0

    def set_transport(self, transport: asyncio.BaseTransport) -> None:
        super().set_transport(transport)
        self._source = cast("asyncio.Transport", transport)
        # Memory for asyncio's quarter of a megabyte would be mapped anew for every read.
        transport.max_size = _READ_BYTES  # type: ignore[attr-defined]

    def feed_data(self, data: Any) -> None:
        super().feed_data(data)
        self._lines += data.count(b"\n")
        if self._lines:
            self._source.pause_reading()

    async def read_line(self) -> bytes:
        """Return the next line; raise what `readuntil` raises."""
        if not self._lines:
            self._source.resume_reading()
        line = await self.readuntil(b"\n")
        self._lines -= 1
        return line

    def end(self) -> None:
        """Read no further."""
        self._source.pause_reading()
        self.feed_eof()


@dataclass(eq=False)
class _Client:
    """A client, and what it is at."""

    reader: _LineReader
    writer: asyncio.StreamWriter
    has_spoken: bool = False
    waits: bool = False
    """Its last request is not answered yet."""
    leaves: bool = False
    """It made room for another one."""

    def is_silent(self) -> bool:
        """Tell whether it waits for no answer, and has sent nothing that is not read yet."""
        if self.waits or self.leaves:
            return False
        arrived = select.poll()
        arrived.register(self.writer.get_extra_info("socket").fileno(), select.POLLIN)
        return not arrived.poll(0)

    def give_way(self) -> None:
        """Disconnect it."""
        self.leaves = True
        self.reader.end()


class SocketError(Exception):
    """The control socket cannot be made. The message says why, and what to do."""

    exit_code = ExitCode.UNAVAILABLE


class Server:
    """Answers requests on a Unix socket."""

    def __init__(self, methods: Methods, now_s: Callable[[], float] = time.monotonic) -> None:
        """`methods` are what can be asked; none may end the process. `now_s` is the clock."""
        self._methods = methods
        self._at_once = {name.encode() for name, method in methods.items() if method.at_once}
        self._now_s = now_s
        self._clients: dict[_Client, None] = {}
        """The one that was heard of last stands last."""
        self._turns = Turns()
        # One after the other in one thread: each further thread would keep memory of its own.
        self._worker = ThreadPoolExecutor(1, "orders")

    async def listen(self, path: Path, group: str | None = None) -> None:
        """Make the socket and answer from now on; raise `SocketError`."""
        bound = _bind_socket(path, group)
        self._path = path
        # Accepting many clients at once would keep the others waiting.
        self._listening = await asyncio.get_running_loop().create_unix_server(
            lambda: asyncio.StreamReaderProtocol(_LineReader(), self._welcome),
            sock=bound,
            backlog=_ACCEPTED_AT_ONCE,
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
        has_room = self._make_room()
        client = _Client(cast("_LineReader", reader), writer)
        self._clients[client] = None
        try:
            await (self._serve(client) if has_room else self._serve_emergency(client))
        except (ConnectionError, TimeoutError, *_NO_LINE):
            pass  # it went, or does not read
        except asyncio.CancelledError:
            pass  # the daemon ends
        finally:
            del self._clients[client]
            writer.transport.abort()

    def _make_room(self) -> bool:
        """Disconnect a client where there are too many; return whether another one is served.

        The new client may want the emergency stop: the one that was silent longest goes. Nobody
        goes who waits for an answer. Who has just come and asked nothing yet goes last.
        """
        among = len(self._clients)
        if among >= MOST_CLIENTS:
            crowded = among >= _MOST_WAITING
            silent = (
                c
                for c in self._clients
                if not c.waits and (c.has_spoken or crowded) and c.is_silent()
            )
            leaving = next(silent, None)
            if leaving is not None:
                leaving.give_way()
        return among < _MOST_WAITING

    async def _serve(self, client: _Client) -> None:
        reader, writer = client.reader, client.writer
        allowance = Allowance(self._now_s())
        writer.transport.set_write_buffer_limits(high=_MOST_UNREAD_BYTES)
        while True:
            try:
                line = await reader.read_line()
            except asyncio.LimitOverrunError:
                message = f"a request is one line of at most {LARGEST_REQUEST} bytes"
                writer.write(encode_failure(RequestError(INVALID_REQUEST, message)))
                await _drain_writer(writer)
                return
            client.has_spoken = client.waits = True
            del self._clients[client]
            self._clients[client] = None
            await self._serve_line(line, allowance, writer)
            await _drain_writer(writer)
            client.waits = False

    async def _serve_emergency(self, client: _Client) -> None:
        """Read one line; do nothing but stop."""
        async with asyncio.timeout(_READS_WITHIN_S):
            line = await client.reader.read_line()
        busy = RequestError(TOO_MANY, "too many clients are waiting; ask again in a moment")
        client.writer.write(self._stop_if_asked(line) or encode_failure(busy))
        await _drain_writer(client.writer)

    async def _serve_line(
        self, line: bytes, allowance: Allowance, writer: asyncio.StreamWriter
    ) -> None:
        began_s = time.monotonic()
        stopped = self._stop_if_asked(line)
        if stopped is None:
            writer.write(await self._answer(line, allowance))
            return
        writer.write(stopped)
        # The next line of this client waits, also where it is another emergency stop.
        async with self._turns.take_turn(time.monotonic() - began_s):
            pass

    def _stop_if_asked(self, line: bytes) -> bytes | None:
        """Carry out an emergency stop and return its answer; None where the line is none.

        It is granted after any number of requests.
        """
        if len(line) > _LONGEST_EMERGENCY or not any(name in line for name in self._at_once):
            return None
        try:
            request = parse_request(line, self._methods)
            if not request.method.at_once:
                return None
        except RequestError:
            return None
        try:
            return encode_result(request.id, _carry_out(request))
        except RequestError as error:
            return encode_failure(error)

    async def _answer(self, line: bytes, allowance: Allowance) -> bytes:
        try:
            async with self._turns.take_turn():
                request = self._admit_request(line, allowance)
                if not request.method.changes:
                    return encode_result(request.id, _carry_out(request))
            events = asyncio.get_running_loop()
            result = await events.run_in_executor(self._worker, _carry_out, request)
            return encode_result(request.id, result)
        except RequestError as error:
            return encode_failure(error)

    def _admit_request(self, line: bytes, allowance: Allowance) -> Request:
        has_tokens = allowance.spend(self._now_s(), len(line))
        message = f"more than {REQUESTS_PER_S:g} requests a second"
        if not has_tokens and len(line) > BYTES_PER_REQUEST:
            raise RequestError(TOO_MANY, message)  # reading it would take long
        request = parse_request(line, self._methods)
        if not has_tokens:
            raise RequestError(TOO_MANY, message, request.id)
        return request


def _carry_out(request: Request) -> object:
    try:
        return request.method.call(request.params)
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
