"""A process that floods a control socket: `python flood.py SOCKET KIND`.

It says `flooding` once the flood is under way, and goes on until its standard input ends.
"""

from __future__ import annotations

import json
import os
import select
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress


def _request(method: str, **params: object) -> bytes:
    document = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
    return json.dumps(document).encode() + b"\n"


def _connect(path: str) -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    client.connect(path)
    return client


def _send(path: str, lines: bytes, *, reads: bool = True) -> None:
    """Send the same lines without end, on a new connection whenever one is closed."""
    while True:
        with suppress(ConnectionError), _connect(path) as client:
            while True:
                rest = memoryview(lines)
                while rest:
                    _, writable, _ = select.select([], [client], [], 0.2)
                    if writable:
                        rest = rest[client.send(rest, socket.MSG_DONTWAIT) :]
                    while reads and select.select([client], [], [], 0)[0]:
                        if not client.recv(1 << 20):
                            raise ConnectionResetError


def _send_slowly(path: str) -> None:
    clients = [_connect(path) for _ in range(60)]
    while True:
        for at, client in enumerate(clients):
            with suppress(OSError):
                client.send(b"e", socket.MSG_DONTWAIT)
                continue
            client.close()
            clients[at] = _connect(path)
        time.sleep(1e-4)


def _ask_in_a_crowd(path: str) -> None:
    """Keep two hundred connections that ask, and replace those that are closed."""
    clients = [_connect(path) for _ in range(200)]
    while True:
        for at, client in enumerate(clients):
            try:
                client.send(_request("status"), socket.MSG_DONTWAIT)
                client.recv(1 << 20, socket.MSG_DONTWAIT)
            except BlockingIOError:
                continue
            except OSError:
                client.close()
                clients[at] = _connect(path)


def _come_and_go(path: str) -> None:
    while True:
        with suppress(ConnectionError), _connect(path) as client:
            client.send(_request("status"))


_STEPS = {"kind": "steps", "steps": [{"valve_v": 99, "hold_s": 1}] * 8000}
KINDS: dict[str, tuple[int, Callable[[str], object]]] = {
    "a burst of the word": (1, lambda path: _send(path, b"estop\n" * 85_000)),
    "a burst that nobody reads": (1, lambda path: _send(path, b"estop\n" * 85_000, reads=False)),
    "malformed lines with the word": (8, lambda path: _send(path, b'{"estop"\n' * 5000)),
    "malformed lines": (8, lambda path: _send(path, b"x\n" * 20_000)),
    "refused lines with the word": (8, lambda path: _send(path, _request("set", estop=1) * 1000)),
    "valid questions": (8, lambda path: _send(path, _request("status") * 1000)),
    "questions that nobody reads": (
        8, lambda path: _send(path, _request("recent", every=1) * 1000, reads=False),
    ),
    "long lines of lists": (8, lambda path: _send(path, b"[" + b"[]," * 85_000 + b"0]\n")),
    "thousands of unknown names": (
        8, lambda path: _send(path, _request("status", **{f"a{i}": 1 for i in range(20_000)})),
    ),
    "long refused experiments": (
        8, lambda path: _send(path, _request("start", experiment=_STEPS, name="x")),
    ),
    "slow writers": (1, _send_slowly),
    "two hundred connections": (1, _ask_in_a_crowd),
    "clients that come and go": (2, _come_and_go),
}  # fmt: skip


def _flood(flood: Callable[[str], object], path: str) -> None:
    with suppress(FileNotFoundError):  # the daemon has ended
        flood(path)


def main() -> None:
    path, kind = sys.argv[1:]
    clients, flood = KINDS[kind]
    for _ in range(clients):
        threading.Thread(target=_flood, args=(flood, path), daemon=True).start()
    time.sleep(0.2)
    print("flooding", flush=True)
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main()
