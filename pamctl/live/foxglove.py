"""Values for Foxglove and Lichtblick over the Foxglove WebSocket, as the log has them.

Topic, schema and bytes of `/pam/tick` are the log's: one layout shows both. Loopback only, through
a gate, and read-only. Needs the package foxglove-sdk, which the extra `live` installs.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import closing

import foxglove
import numpy as np

from pamctl.live.feed import Feed, Glimpse
from pamctl.live.gate import Gate, hidden_address
from pamctl.log.schema import TICK_MESSAGE, TICK_TOPIC, tick_descriptor, units_of_columns
from pamctl.log.wire import TickLayout
from pamctl.signals import TICK_FIELDS

STATUS_TOPIC = "/pam/status"
LOOKS_PER_S = 20.0
EVERY = 10
"""Every tenth tick is sent: 100 a second."""


class Telemetry:
    """The channels, and what is sent on them."""

    def __init__(self) -> None:
        """Open the channels."""
        descriptor = tick_descriptor(TICK_FIELDS)
        self._layout = TickLayout.of_fields(TICK_FIELDS)
        self._columns = np.zeros(1, [(field.name, field.kind) for field in TICK_FIELDS])
        self._ticks = foxglove.Channel(
            TICK_TOPIC,
            message_encoding="protobuf",
            schema=foxglove.Schema(name=TICK_MESSAGE, encoding="protobuf", data=descriptor),
            metadata={"units": json.dumps(units_of_columns(TICK_FIELDS))},
        )
        self._status = foxglove.Channel(
            STATUS_TOPIC, message_encoding="json", schema={"type": "object"}
        )

    def send(self, glimpse: Glimpse) -> None:
        """Send what is new."""
        # The loop's times are monotonic; viewers want the time of day.
        offset_ns = time.time_ns() - time.monotonic_ns()
        for tick in glimpse.ticks:
            self._ticks.log(self._pack_tick(tick), log_time=int(tick["encoder_t_ns"]) + offset_ns)
        if glimpse.status is not None:
            status = {k: v for k, v in glimpse.status.items() if k != "tick"}
            self._status.log(status)

    def _pack_tick(self, tick: Mapping[str, float]) -> bytes:
        for field in TICK_FIELDS:
            self._columns[field.name] = tick[field.name]
        return self._layout.encode(self._columns).tobytes()


def serve_foxglove(
    feed: Feed, port: int, origins: Collection[str], goes_on: Callable[[float], bool]
) -> None:
    """Send what the feed sees while `goes_on(seconds)`, which sleeps that long, returns True.

    `origins` are the sites whose pages may watch. Raises `OSError` where the port is taken.
    """
    hidden = hidden_address()
    server = foxglove.start_server(name="pamctl", host=hidden, port=0)
    try:
        with closing(Gate(port, (hidden, server.port), origins)) as gate:
            print(f"live: ws://127.0.0.1:{gate.port} (Foxglove, Lichtblick)", flush=True)
            telemetry = Telemetry()
            while goes_on(1.0 / LOOKS_PER_S):
                telemetry.send(feed.look())
            telemetry.send(feed.look())
    finally:
        server.stop()
