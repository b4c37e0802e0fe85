"""What the daemon tells: events as lines, signs of life, and what the monitor has found."""

from __future__ import annotations

import json
import os
import queue
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pamctl.daemon.protocol import RequestRefusedError
from pamctl.plain_text import LONGEST_REMARK
from pamctl.plant.model import PlantSettings
from pamctl.watch.monitor_handle import MonitorHandle, format_alarm, format_monitor

_MOST_WAITING = 1000
_LAST_PATIENCE_S = 1.0
_MARK_PATIENCE_S = 0.1
"""A loop takes a mark within some ticks; a trip waits no longer for it (s)."""


class Announcements:
    """A queue of lines, and the thread that writes them."""

    def __init__(self, fd: int) -> None:
        """Write to `fd` without Python's buffer: a stuck line cannot delay the exit."""
        self._fd = fd
        self._waiting: queue.Queue[bytes] = queue.Queue(_MOST_WAITING)
        self._thread = threading.Thread(target=self._write, name="announcements", daemon=True)
        self._thread.start()

    def put(self, event: Mapping[str, object]) -> None:
        """Put an event into the queue; never wait."""
        with suppress(queue.Full):
            self._waiting.put_nowait(json.dumps(event).encode() + b"\n")

    def end(self) -> None:
        """Wait a moment for the last lines to be written."""
        with suppress(queue.Full):
            self._waiting.put_nowait(b"")
        self._thread.join(_LAST_PATIENCE_S)

    def _write(self) -> None:
        with suppress(OSError):  # the reader has gone
            while line := self._waiting.get():
                while line:
                    line = line[os.write(self._fd, line) :]


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


class MonitorDesk:
    """The monitor of one daemon, or none: then every call does nothing."""

    def __init__(
        self,
        plant: PlantSettings | None,
        announce: Callable[..., None],
        mark: Callable[[str], None],
        trip: Callable[[str], None] | None,
    ) -> None:
        """Start a monitor that follows `plant`; None starts none. An alarm calls `trip`, if any."""
        self._announce, self._mark, self._trip = announce, mark, trip
        self._handle = None if plant is None else MonitorHandle(plant, self._take)

    @property
    def pids(self) -> dict[str, int]:
        """Process id, by role."""
        return {} if self._handle is None else {"monitor": self._handle.pid}

    def status(self) -> dict[str, Any] | None:
        """Return the state of both blocks with a sentence; None without a monitor."""
        if self._handle is None:
            return None
        found = self._handle.status()
        return {**found, "sentence": format_monitor(found)}

    def begin_run(self, name: str, ring: Path) -> None:
        """Let the monitor follow a run."""
        if self._handle is not None:
            self._handle.begin_run(name, ring)

    def _take(self, report: Mapping[str, Any]) -> None:
        details = {k: v for k, v in report.items() if k != "kind"}
        match report["kind"]:
            case "alarm":
                text = format_alarm(report)
                self._announce("monitor alarm", text=text, **details)
                # The log should say why, but the valve does not wait for a mark that is held up.
                note = threading.Thread(target=self._note, args=(text,), daemon=True)
                note.start()
                note.join(None if self._trip is None else _MARK_PATIENCE_S)
                if self._trip is not None:
                    self._trip(f"monitor: {text}")
            case "alarm over":
                text = f"the {report['block']} block is back at its floor"
                self._announce("monitor alarm over", text=text, **details)
                self._note(text)
            case "explained":
                self._announce("monitor explanation", text=report["sentence"], **details)
                self._note(report["sentence"])
            case "ended":
                self._announce("monitor ended", text=report["problem"])

    def _note(self, text: str) -> None:
        with suppress(RequestRefusedError):  # nothing is being logged
            self._mark(f"monitor: {text}"[:LONGEST_REMARK])

    def close(self) -> None:
        """End the monitor."""
        if self._handle is not None:
            self._handle.close()
