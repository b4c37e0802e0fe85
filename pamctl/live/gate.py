"""Who may watch over the WebSocket: a check that foxglove-sdk's server does not make.

A page of any site may open a WebSocket to this PC; its browser says in `Origin` whose page it is.
The public port therefore belongs to this gate. It reads the head of the request, and passes the
connection on or refuses it. The server behind it listens on a random loopback address and port,
one of some 2^37: a page could try them for years.
"""

from __future__ import annotations

import asyncio
import io
import secrets
import socket
import threading
from collections.abc import Collection, Coroutine
from contextlib import suppress
from http.client import HTTPException, parse_headers
from typing import NamedTuple

MOST_CONNECTIONS = 16
LARGEST_HEAD = 1 << 14
_HEAD_WITHIN_S = 5.0
_PIECE = 1 << 16


class GateRefusal(NamedTuple):
    """Why a connection is not passed on."""

    status: str
    reason: str


def hidden_address() -> str:
    """Return a loopback address that nobody else uses or can guess."""
    return "127." + ".".join(str(1 + secrets.randbelow(254)) for _ in range(3))


def judge_request_head(head: bytes, port: int, origins: Collection[str]) -> GateRefusal | None:
    """Judge the head of an HTTP request to `port`; `origins` are the sites that may watch.

    A program sends no origin, and an application its own scheme (`file://`): both may. A page
    has its site's, or `null` where it hides it.
    """
    try:
        _, rest = head.split(b"\r\n", 1)
        headers = parse_headers(io.BytesIO(rest))
    except (ValueError, HTTPException):
        return GateRefusal("400 Bad Request", "this is no request")
    hosts, senders = headers.get_all("Host", []), headers.get_all("Origin", [])
    if hosts not in ([f"127.0.0.1:{port}"], [f"localhost:{port}"]):
        return GateRefusal("421 Misdirected Request", "this is not the host you asked for")
    if not senders or (senders[0] in origins and len(senders) == 1):
        return None
    is_page = any(one == "null" or one.lower().startswith(("http:", "https:")) for one in senders)
    if is_page or len(senders) > 1:
        fix = "name this site with --live-origin if it may watch"
        return GateRefusal("403 Forbidden", f"pages of other sites may not watch; {fix}")
    return None


class Gate:
    """Listens on the loopback address, in a thread of its own."""

    def __init__(self, port: int, behind: tuple[str, int], origins: Collection[str]) -> None:
        """Listen on `port` for the server `behind`; raise `OSError` where it cannot be had."""
        self._socket = socket.create_server(("127.0.0.1", port))
        self.port: int = self._socket.getsockname()[1]
        self._behind = behind
        self._origins = frozenset(origins)
        self._connections = 0
        self._events = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="gate", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        asyncio.set_event_loop(self._events)
        serving = asyncio.start_server(self._welcome, sock=self._socket, limit=LARGEST_HEAD)
        self._events.run_until_complete(serving)
        self._events.run_forever()

    def close(self) -> None:
        """Accept no more connections."""
        self._events.call_soon_threadsafe(self._events.stop)
        self._thread.join()
        self._socket.close()

    async def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._connections >= MOST_CONNECTIONS:
            writer.close()
            return
        self._connections += 1
        try:
            await self._serve(reader, writer)
        # The client vanished, sent nothing or too much, or the server behind has ended.
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass
        finally:
            self._connections -= 1
            writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(_HEAD_WITHIN_S):
            head = await reader.readuntil(b"\r\n\r\n")
        refusal = judge_request_head(head, self.port, self._origins)
        if refusal is not None:
            writer.write(_encode_refusal(refusal))
            await writer.drain()
            return
        its_reader, its_writer = await asyncio.open_connection(*self._behind)
        try:
            its_writer.write(head)
            await _await_first(_copy_stream(reader, its_writer), _copy_stream(its_reader, writer))
        finally:
            its_writer.close()


async def _copy_stream(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    """Copy to the end. A slow reader slows the writer, which then skips values."""
    with suppress(ConnectionError):
        while piece := await source.read(_PIECE):
            sink.write(piece)
            await sink.drain()


async def _await_first(*ways: Coroutine[None, None, None]) -> None:
    """Wait until one of them has ended; end the others."""
    tasks = [asyncio.ensure_future(way) for way in ways]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()


def _encode_refusal(refusal: GateRefusal) -> bytes:
    body = refusal.reason.encode() + b"\n"
    head = f"HTTP/1.1 {refusal.status}\r\nContent-Type: text/plain\r\n"
    return f"{head}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body
