"""The control socket: many clients, none of which can disturb the others or the loop.

The socket has mode 0660: its group may steer. What a client sends is limited in size and
rate. A client that does not read its answers is disconnected. Clients wait for each other;
a request for the emergency stop waits for nobody.
"""

from __future__ import annotations

import asyncio
import grp
import os
import socket
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, nullcontext, suppress
from pathlib import Path

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
_READS_WITHIN_S = 2.0
_MOST_UNREAD_BYTES = 1 << 20
_EMERGENCY = b"estop"
_STEPS_OF_A_WELCOME = 4
"""Rounds of the event loop from a client's connection to its first line: see, accept, attach."""

REQUESTS_PER_S = 100.0
BURST = 200.0

Methods = dict[str, Method]


class Allowance:
    """The requests that a client may still make: a bucket that fills with time."""

    def __init__(self, now_s: float) -> None:
        """Begin with a full bucket."""
        self._tokens, self._last_s = BURST, now_s

    def spend(self, now_s: float) -> bool:
        """Take one token; return whether there was one."""
        self._tokens = min(BURST, self._tokens + (now_s - self._last_s) * REQUESTS_PER_S)
        self._last_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


class Turns:
    """Clients wait here for each other, and together take at most half of the time.

    The watch over the loop shares the interpreter: however much is asked, it finds every other
    moment free.
    """

    def __init__(self) -> None:
        """Begin with nobody waiting."""
        self._lock = asyncio.Lock()  # first come, first served

    @asynccontextmanager
    async def take_turn(self) -> AsyncIterator[None]:
        """Wait for a turn; after it, nobody has one for as long as it took."""
        async with self._lock:
            began_s = time.monotonic()
            try:
                yield
            finally:
                await asyncio.sleep(time.monotonic() - began_s)


class SocketError(Exception):
    """The control socket cannot be made. The message says why, and what to do."""

    exit_code = ExitCode.UNAVAILABLE


class Server:
    """Answers requests on a Unix socket."""

    def __init__(self, methods: Methods, now_s: Callable[[], float] = time.monotonic) -> None:
        """`methods` are what can be asked; none may end the process. `now_s` is the clock."""
        self._methods = methods
        self._now_s = now_s
        self._clients: dict[asyncio.Task[None], float] = {}
        """Each with the time of its last request."""
        self._turns = Turns()
        # One after the other in one thread: each further thread would keep memory of its own.
        self._worker = ThreadPoolExecutor(1, "orders")

    async def listen(self, path: Path, group: str | None = None) -> None:
        """Make the socket and answer from now on; raise `SocketError`."""
        bound = _bind_socket(path, group)
        self._path = path
        self._listening = await asyncio.start_unix_server(
            self._welcome, sock=bound, limit=LARGEST_REQUEST
        )

    async def close(self) -> None:
        """Take no more clients and remove the socket; those connected are still answered."""
        self._path.unlink(missing_ok=True)
        # A client may be accepted and not yet served. asyncio forgets such clients when it
        # closes, and they would wait for an answer as long as this process lives.
        for _ in range(_STEPS_OF_A_WELCOME):
            await asyncio.sleep(0)
        self._listening.close()

    async def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if len(self._clients) >= MOST_CLIENTS:
            # The new client stays: it may want the emergency stop.
            min(self._clients, key=self._clients.__getitem__).cancel()
        self._clients[task] = self._now_s()
        try:
            await self._serve(task, reader, writer)
        except (ConnectionError, TimeoutError):
            pass  # it went, or does not read
        except asyncio.CancelledError:
            pass  # the daemon ends, or this client was silent longest and made room
        finally:
            self._clients.pop(task, None)
            writer.transport.abort()

    async def _serve(
        self,
        task: asyncio.Task[None],
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        allowance = Allowance(self._now_s())
        writer.transport.set_write_buffer_limits(high=_MOST_UNREAD_BYTES)
        while True:
            try:
                line = await reader.readuntil(b"\n")
            except asyncio.IncompleteReadError:
                return
            except asyncio.LimitOverrunError:
                message = f"a request is one line of at most {LARGEST_REQUEST} bytes"
                writer.write(encode_failure(RequestError(INVALID_REQUEST, message)))
                await _drain_writer(writer)
                return
            self._clients[task] = self._now_s()
            writer.write(await self._answer(line, allowance))
            await _drain_writer(writer)

    async def _answer(self, line: bytes, allowance: Allowance) -> bytes:
        try:
            async with nullcontext() if _EMERGENCY in line else self._turns.take_turn():
                request = self._admit_request(line, allowance)
                if not request.method.changes:
                    return encode_result(request.id, _carry_out(request))
            events = asyncio.get_running_loop()
            result = await events.run_in_executor(self._worker, _carry_out, request)
            return encode_result(request.id, result)
        except RequestError as error:
            return encode_failure(error)

    def _admit_request(self, line: bytes, allowance: Allowance) -> Request:
        request = parse_request(line, self._methods)
        # The emergency stop is granted after any number of requests.
        if request.name != "estop" and not allowance.spend(self._now_s()):
            message = f"more than {REQUESTS_PER_S:g} requests a second"
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
