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

import numpy as np
import pytest
from daemons import QUICK, daemon
from patience import BUSY_PC, PATIENCE_S

from pamctl.cli.assembly import ao_path
from pamctl.log import read
from pamctl.log.schema import TICK_TOPIC
from pamctl.log.wire import one_by_one

pytest.importorskip("foxglove", reason="the extra pamctl[live] is not installed")
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
    """Subscription, time, payload of all that arrives, until there are so many ticks in it."""
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
    received = one_by_one(schema, "pamctl.Tick")(payloads)
    assert np.all(received["tick"] % 10 == 0)
    rows, ours = np.intersect1d(log["tick"], received["tick"], return_indices=True)[1:]
    for name in log.columns:
        assert log[name][rows].tobytes() == received[name][ours].tobytes(), name
    return len(rows)


def test_a_run_is_seen_as_its_log_has_it(tmp_path: Path) -> None:
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


def test_a_daemon_is_seen_in_all_its_states_and_its_runs_as_their_logs_have_them(
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


def test_a_port_that_is_taken_is_said_and_the_run_goes_on(tmp_path: Path) -> None:
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


def test_without_a_clock_there_is_nothing_live_and_without_the_extra_one_is_told() -> None:
    command = [sys.executable, "-m", "pamctl", "run", "--fast", "--live"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert "without a clock" in done.stderr
    hidden = "import sys; sys.modules['foxglove'] = None; import pamctl.cli.app as a; a.app()"
    command = [sys.executable, "-c", hidden, "run", "--live"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 69
    assert re.search(r"foxglove-sdk.*pip install 'pamctl\[live\]'", done.stderr)
