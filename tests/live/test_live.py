"""`--live`: what a Foxglove client receives is what the log has."""

from __future__ import annotations

import json
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command_line import run_pamctl
from support.patience import BUSY_PC, PATIENCE_S
from support.processes.daemons import QUICK, daemon
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.live.gate import judge_request_head
from pamctl.log import read
from pamctl.log.schema import TICK_TOPIC
from pamctl.log.wire import make_decoder
from pamctl.processes.backends import ao_path

pytest.importorskip("foxglove", reason="the extra pamctl[live] is not installed")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

NOT_HOMED = "rig.homing.enabled=false"
MESSAGE = struct.Struct("<BIQ")
"""Opcode 1, subscription, time: the binary frame of the protocol, before the message."""
TICK_SUBSCRIPTION, STATUS_SUBSCRIPTION = 1, 2


@contextmanager
def subscribed(port: int) -> Iterator[tuple[ClientConnection, bytes]]:
    """Connect as Foxglove does, subscribe to both topics; yield the schema of a tick too."""
    protocol = Subprotocol("foxglove.sdk.v1")
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol]) as connection:
        channels: dict[str, Any] = {}
        while len(channels) < 2:
            said = json.loads(connection.recv(PATIENCE_S))
            if said["op"] == "advertise":
                channels |= {channel["topic"]: channel for channel in said["channels"]}
        tick, status = channels[TICK_TOPIC], channels["/pam/status"]
        assert (tick["encoding"], tick["schemaName"]) == ("protobuf", "pamctl.Tick")
        wanted = [
            {"id": TICK_SUBSCRIPTION, "channelId": tick["id"]},
            {"id": STATUS_SUBSCRIPTION, "channelId": status["id"]},
        ]
        connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        yield connection, b64decode(tick["schema"])


def port_told(errors: Path) -> int:
    """Wait until it is said on standard error where it is served."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not (found := re.search(r"ws://127\.0\.0\.1:(\d+)", errors.read_text())):
        assert time.monotonic() < deadline_s, errors.read_text()
        time.sleep(0.05)
    return int(found[1])


def messages(connection: ClientConnection, ticks: int) -> list[tuple[int, int, bytes]]:
    """Return subscription, time and payload of each message until `ticks` ticks are among them."""
    got: list[tuple[int, int, bytes]] = []
    while sum(subscription == TICK_SUBSCRIPTION for subscription, *_ in got) < ticks:
        frame = connection.recv(PATIENCE_S)
        if isinstance(frame, bytes) and frame[0] == 1:
            _, subscription, t_ns = MESSAGE.unpack_from(frame)
            got.append((subscription, t_ns, frame[MESSAGE.size :]))
    return got


def assert_equal_to_the_log(path: Path, schema: bytes, payloads: list[bytes]) -> int:
    """Compare to the bit, and return how many of the ticks are in the log."""
    log = read(path)
    received = make_decoder(schema, "pamctl.Tick")(payloads)
    assert np.all(received["tick"] % 10 == 0)
    rows, ours = np.intersect1d(log["tick"], received["tick"], return_indices=True)[1:]
    for name in log.columns:
        assert log[name][rows].tobytes() == received[name][ours].tobytes(), name
    return len(rows)


@pytest.mark.long
def test_a_viewer_of_a_run_receives_what_the_log_holds(tmp_path: Path) -> None:
    device, log, errors = f"test-live-{time.time_ns()}", tmp_path / "run.mcap", tmp_path / "err"
    # Longer than the busiest PC needs to serve it: it is ended when enough was seen.
    settings = [f"rig.sim.device={device}", NOT_HOMED, *QUICK, *BUSY_PC, "experiment.cycles=50"]
    command = [sys.executable, "-m", "pamctl", "run", "--quiet"]
    command += ["--log", str(log), "--live", "--live-port", "0"]
    command += [part for setting in settings for part in ("--set", setting)]
    with errors.open("w") as said:
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said)
    try:
        with subscribed(port_told(errors)) as (connection, schema):
            got = [m for m in messages(connection, 100) if m[0] == TICK_SUBSCRIPTION]
        run.send_signal(signal.SIGINT)
        assert run.wait(PATIENCE_S) == 130, errors.read_text()
    finally:
        run.kill()
        run.wait()
        for left in (ao_path(device), ao_path(device).with_suffix(".lock")):
            left.unlink(missing_ok=True)
    assert assert_equal_to_the_log(log, schema, [payload for *_, payload in got]) > 50
    times_s = np.diff([t_ns for _, t_ns, _ in got]) * 1e-9
    assert np.all(times_s > 0)


@pytest.mark.long
def test_a_viewer_of_the_daemon_receives_its_states_and_what_the_logs_hold(
    tmp_path: Path,
) -> None:
    live = ["--live", "--live-port", "0"]
    with (
        daemon(tmp_path, "live", NOT_HOMED, options=live) as made,
        subscribed(port_told(tmp_path / "daemon.err")) as (connection, schema),
    ):
        log = made.ask("goto", position_m=8e-3, within_s=1.0)["log"]
        made.wait_until(lambda status: status["state"] == "ready" and status["log"] is not None)
        got = messages(connection, 200)
        made.ask("stop")
        made.wait_until(lambda status: not status["log"])
    ticks = [payload for subscription, _, payload in got if subscription == TICK_SUBSCRIPTION]
    assert assert_equal_to_the_log(Path(log), schema, ticks) > 50
    states = {json.loads(p)["state"] for subscription, _, p in got if subscription != 1}
    assert states & {"running", "ready"}


SITE = "https://app.foxglove.dev"


def head(*lines: str) -> bytes:
    return "\r\n".join(["GET / HTTP/1.1", *lines, "Upgrade: websocket", "", ""]).encode()


@pytest.mark.parametrize(
    ("lines", "status"),
    [
        (["Host: 127.0.0.1:8765"], None),
        (["Host: localhost:8765", "Origin: file://"], None),
        (["Host: localhost:8765", f"Origin: {SITE}"], None),
        (["Host: localhost:8765", "Origin: https://app.foxglove.dev.evil.example"], "403"),
        (["Host: localhost:8765", "Origin: HTTPS://evil.example"], "403"),
        (["Host: localhost:8765", "Origin: http://localhost:8765"], "403"),
        (["Host: localhost:8765", "Origin: null"], "403"),
        (["Host: localhost:8765", "Origin: file://", "Origin: https://evil.example"], "403"),
        (["Host: localhost:8765", f"Origin: {SITE}", f"Origin: {SITE}"], "403"),
        (["Host: evil.example:8765"], "421"),
        (["Host: 127.0.0.1:8765", "Host: evil.example"], "421"),
        ([], "421"),
    ],
    ids=str,
)
def test_only_local_programs_and_named_sites_may_watch(
    lines: list[str], status: str | None
) -> None:
    refusal = judge_request_head(head(*lines), 8765, {SITE})
    assert (refusal and refusal.status[:3]) == status


@given(st.binary(max_size=200))
def test_any_first_bytes_of_a_request_are_judged(garbage: bytes) -> None:
    assert judge_request_head(garbage + b"\r\n\r\n", 8765, ()) is not None


def test_pages_of_other_sites_cannot_watch(
    tmp_path: Path,
) -> None:
    live = ["--live", "--live-port", "0", "--live-origin", SITE]
    with daemon(tmp_path, "gate", NOT_HOMED, options=live):
        port = port_told(tmp_path / "daemon.err")
        for origin in (None, "file://", SITE):
            with _connected(port, origin) as connection:
                assert json.loads(connection.recv(PATIENCE_S))["op"] == "serverInfo"
        for origin in ("https://evil.example", "null", f"http://127.0.0.1:{port}"):
            with pytest.raises(InvalidStatus, match="403"), _connected(port, origin):
                pass
        with socket.create_connection(("127.0.0.1", port)) as flood, pytest.raises(ConnectionError):
            for _ in range(1000):
                flood.sendall(b"x" * 65536)


def _connected(port: int, origin: Any) -> ClientConnection:
    protocol = Subprotocol("foxglove.sdk.v1")
    return connect(f"ws://localhost:{port}", subprotocols=[protocol], origin=origin)


def test_a_taken_port_is_reported_and_the_run_goes_on(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        options = ["--live", "--live-port", str(taken.getsockname()[1])]
        with daemon(tmp_path, "taken", NOT_HOMED, options=options) as made:
            made.wait_for("idle")
            said, deadline_s = "", time.monotonic() + PATIENCE_S
            while "live: not served" not in said:
                assert time.monotonic() < deadline_s, said
                time.sleep(0.05)
                said = (tmp_path / "daemon.err").read_text()
            assert made.state() == "idle"


@pytest.mark.parametrize("verb", ["run", "daemon"])
def test_live_origin_without_live_is_refused(verb: str) -> None:
    done = run_pamctl(verb, "--live-origin", SITE)
    assert done.returncode == 2
    assert "for --live-origin: belongs to --live" in done.stderr


@pytest.mark.parametrize("verb", ["run", "daemon"])
def test_the_help_says_which_extra_is_needed(verb: str) -> None:
    shown = CliRunner().invoke(app, [verb, "--help"]).stdout
    assert "extra 'live'" in " ".join(shown.replace("│", " ").split())


def test_live_needs_a_clock_and_the_extra() -> None:
    done = run_pamctl("run", "--fast", "--live")
    assert done.returncode == 2
    assert "without a clock" in done.stderr
    with patch.dict(sys.modules, {"foxglove": None}):
        done = run_pamctl("run", "--live")
    assert done.returncode == 69
    assert re.search(r"foxglove-sdk.*pip install '.\[live\]'", done.stderr)
