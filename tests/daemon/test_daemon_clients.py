"""Clients of the daemon that hang, flood, send garbage or vanish do not disturb others."""

import asyncio
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.patience import PATIENCE_S
from support.processes.daemons import Daemon, daemon

from pamctl.daemon import client
from pamctl.daemon.protocol import (
    LARGEST_REQUEST,
    OrderTaker,
    RequestError,
    encode_failure,
    encode_result,
    list_orders,
    order,
    parse_request,
)
from pamctl.daemon.server import Server

STOPS: list[object] = []


class Told(OrderTaker):
    @order(changes=False)
    def status(self) -> dict[str, Any]:
        return {}

    @order(changes=False, at_once=True)
    def estop(self) -> None:
        STOPS.append(None)


ORDERS = list_orders(Told)

anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


# --- where a daemon listens ------------------------------------------------------------------


def test_a_client_looks_for_the_daemon_of_its_user_and_then_for_that_of_the_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system, own = tmp_path / "control.sock", tmp_path / "pamctl.sock"
    monkeypatch.setattr(client, "_SYSTEM_SOCKET", system)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert client.own_socket() == client.default_socket() == system
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert client.own_socket() == client.default_socket() == own
    system.touch()
    assert client.default_socket() == system
    own.touch()
    assert client.default_socket() == own


# --- what a request is, without a socket -----------------------------------------------------


@given(st.binary(max_size=400))
def test_any_bytes_get_one_line_of_json_as_answer(line):
    assert_refused_in_one_line(line)


@settings(max_examples=20)
@given(
    st.fixed_dictionaries(
        {}, optional={"jsonrpc": st.just("2.0") | anything, "id": anything, "method": anything}
    )
)
def test_any_document_gets_one_line_of_json_as_answer(document):
    assert_refused_in_one_line(json.dumps({**document, "params": {"x": 1}}).encode())


def assert_refused_in_one_line(line: bytes) -> None:
    with pytest.raises(RequestError) as caught:
        parse_request(line, ORDERS)
    answer = encode_failure(caught.value)
    assert answer.count(b"\n") == 1
    told = json.loads(answer)
    assert told["error"]["message"]
    assert told["error"]["code"] < 0


@given(st.integers() | st.text())
def test_an_answer_carries_the_number_of_its_request(number):
    line = json.dumps({"jsonrpc": "2.0", "id": number, "method": "status"}).encode()
    request = parse_request(line, ORDERS)
    assert json.loads(encode_result(request.id, {"state": "idle"})) == {
        "jsonrpc": "2.0",
        "id": number,
        "result": {"state": "idle"},
    }


def test_deeply_nested_json_is_refused_as_invalid():
    assert_refused_in_one_line(b"[" * 100_000)


# --- a daemon that holds a position while they try ------------------------------------------------


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with daemon(tmp_path_factory.mktemp("held"), "held", "rig.homing.enabled=false") as made:
        made.ask("goto", position_m=8e-3, within_s=0.5)
        made.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None)
        yield made


@contextmanager
def unaffected(made: Daemon) -> Iterator[Callable[[], None]]:
    """The loop goes on, the position is held, and honest clients are answered all the while.

    What it yields returns once one has been, asked no earlier than now: whatever another client
    is at in the meantime, nobody waits for it to come to its end.
    """
    before = made.ask("status")
    answers, stop = threading.Semaphore(0), threading.Event()

    def honest() -> None:
        with made.client() as client:
            while not stop.is_set():
                client.call("status")
                answers.release()
                time.sleep(0.05)

    def answered() -> None:
        while answers.acquire(blocking=False):
            pass
        for _ in range(2):  # the first may have been asked for before
            assert answers.acquire(timeout=PATIENCE_S)

    thread = threading.Thread(target=honest)
    thread.start()
    try:
        yield answered
    finally:
        stop.set()
        thread.join(PATIENCE_S)
    after = made.wait_until(lambda s: s["tick"]["tick"] > before["tick"]["tick"])
    assert not thread.is_alive()
    assert (after["state"], after["log"]) == (before["state"], before["log"])
    assert after["tick"]["reference_m"] == before["tick"]["reference_m"]
    assert after["controller"] == before["controller"]


def connected(made: Daemon) -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(PATIENCE_S)
    client.connect(str(made.socket))
    return client


def request(method: str, **params: Any) -> bytes:
    document = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
    return json.dumps(document).encode() + b"\n"


def test_a_silent_client_and_one_with_half_a_message_disturb_nobody(held):
    with unaffected(held) as answered, connected(held) as silent, connected(held) as half:
        half.sendall(request("status")[:-5])
        answered()
        # Not because the others had been given up.
        half.sendall(request("status")[-5:])
        silent.sendall(request("status"))
        for client in (half, silent):
            assert b"result" in client.makefile("rb").readline()


def test_a_client_may_vanish_within_a_message_or_before_its_answer(held):
    with unaffected(held) as answered:
        for sent in (request("stop")[:-5], request("status")):
            client = connected(held)
            client.sendall(sent)
            client.close()
            answered()


def test_a_client_that_sends_garbage_is_answered_and_may_continue(held):
    with unaffected(held), connected(held) as client:
        answers = client.makefile("rb")
        for garbage in (b"\x00\xff\n", b"{}\n", b"[1,2]\n", b'"stop"\n', b"\n"):
            client.sendall(garbage)
            assert json.loads(answers.readline())["error"]["code"] in (-32700, -32600)
        client.sendall(request("status"))
        assert json.loads(answers.readline())["result"]["state"] == "ready"


def test_a_client_that_sends_a_hundred_megabytes_is_disconnected_early(held):
    sent = 0
    with unaffected(held), connected(held) as client, suppress(OSError):
        while sent < 100e6:
            sent += client.send(b"x" * 65536)
    assert sent < 100 * LARGEST_REQUEST


def test_a_client_that_floods_is_answered_in_its_order_and_may_stop(tmp_path):
    STOPS.clear()

    async def flooded() -> list[dict[str, Any]]:
        server = Server(Told())
        await server.listen(tmp_path / "socket")
        answers, client = await asyncio.open_unix_connection(tmp_path / "socket")
        client.write(request("status") * 400 + request("estop"))
        told = [json.loads(await answers.readline()) for _ in range(401)]
        await server.close()
        client.transport.abort()
        await asyncio.sleep(0.05)
        return told

    told = asyncio.run(flooded())
    assert [answer["result"] for answer in told] == [*[{}] * 400, None]
    assert len(STOPS) == 1


def test_a_client_that_never_reads_is_disconnected(held):
    with unaffected(held) as answered, connected(held) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.settimeout(0.5)
        with suppress(OSError):
            for _ in range(20_000):
                client.sendall(request("status") * 10)
        answered()


@pytest.mark.parametrize("turns", [0, 2, 5])
def test_a_client_that_connects_as_the_socket_closes_is_answered(tmp_path, turns):
    async def late() -> bytes:
        server = Server(Told())
        await server.listen(tmp_path / "socket")
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(tmp_path / "socket"))
            client.sendall(request("status"))
            for _ in range(turns):
                await asyncio.sleep(0)
            await server.close()
            client.settimeout(PATIENCE_S)
            return await asyncio.to_thread(client.recv, 1000)

    assert b'"result":{}' in asyncio.run(late())
    assert not (tmp_path / "socket").exists()


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.binary(max_size=60)
        | st.sampled_from([request("status"), request("set"), request("mark", text=1), b"\n"]),
        max_size=6,
    )
)
def test_no_sequence_of_bytes_stops_the_loop_or_moves_the_muscle(held, pieces):
    with connected(held) as client, suppress(OSError):
        for piece in pieces:
            client.sendall(piece)
        client.shutdown(socket.SHUT_WR)
        while client.recv(65536):
            pass
    status = held.ask("status")
    assert status["state"] == "ready"
    assert status["tick"]["reference_m"] == pytest.approx(8e-3)
