"""Messages to a service manager: READY, STATUS, WATCHDOG, STOPPING (sd_notify)."""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def notify(*assignments: str) -> None:
    """Send assignments such as `READY=1`; nothing happens where no manager listens."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    # The daemon goes on if the manager has gone.
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.connect(address)
        manager.sendall("\n".join(assignments).encode())


def watchdog_period_s() -> float | None:
    """Return the longest time between two signs of life; None where none are wanted."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    micros = os.environ.get("WATCHDOG_USEC", "")
    return int(micros) * 1e-6 if micros.isdecimal() and int(micros) > 0 else None
