"""The daemon while it is up: the server, and the watch over session and run."""

from __future__ import annotations

import asyncio
import gc
import json
import os
import queue
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from pamctl import __version__
from pamctl.base.errors import Ending, ExitCode
from pamctl.daemon.rig_session import RigSession
from pamctl.daemon.server import Server, find_group, require_no_daemon
from pamctl.daemon.session import Workshop
from pamctl.daemon.session_life import RigState
from pamctl.daemon.shelf import Latch, Shelf
from pamctl.plant.model import PlantSettings
from pamctl.processes.backends import (
    SHARED_MEMORY,
    device_of,
    require_backend,
    require_open_files,
    secure_device,
)
from pamctl.processes.interrupts import STOP_SIGNALS, keep_awake
from pamctl.processes.run_once import build_machine_code
from pamctl.recording.recorder import finish_orphans, ignore_signals
from pamctl.settings.resolve import RunSettings

_LOOK_EVERY_S = 5e-3
_TURN_OF_A_THREAD_S = 5e-4
_END_PATIENCE_S = 10.0
_OWN_ERROR = Ending(ExitCode.UNEXPECTED, "an error of the daemon's own")

Tell = Callable[[Mapping[str, object]], object]


def serve_daemon(
    settings: RunSettings,
    names: Mapping[str, str],
    *,
    socket: Path,
    group: str | None,
    logs: Path,
    keep: int | None,
    idle_after_s: float,
    announce: bool,
    file_gains: Mapping[str, Any],
    watched: PlantSettings | None = None,
    monitor_trips: bool = False,
) -> ExitCode:
    """Hold the device and do what clients ask until a signal comes; return how it ended.

    Who is in `group` may steer, beside this user. Of the daemon's logs the newest `keep` stay; None
    keeps all. With `announce` each event is printed as a line of JSON. The rest is as for
    `RigSession`. Raises `ShelfError` where logs cannot be written, `RigError`, `RingError` or
    `SocketError` where the device or the socket cannot be had.
    """
    # First: whoever starts a second daemon wants to hear of the first, not of its device.
    require_no_daemon(socket)
    shelf = Shelf(logs, keep)
    announcements = Announcements(sys.stdout.fileno()) if announce else None
    tell: Tell = (lambda event: None) if announcements is None else announcements.put
    try:
        require_open_files()
        require_backend(settings.rig)
        build_machine_code(settings)
        with keep_awake() as risk:  # each session asks anew; only now somebody reads the answer
            if risk:
                print(f"note: {risk}", file=sys.stderr, flush=True)
        with secure_device(settings.rig) as device:
            finish_orphans(SHARED_MEMORY, quiet=False)
            service = RigSession(
                settings,
                names,
                Workshop(device, device_of(settings.rig), find_group(group)),
                shelf,
                Latch(SHARED_MEMORY / f"pamctl-{device_of(settings.rig)}.fault"),
                file_gains=file_gains,
                idle_after_s=idle_after_s,
                tell=tell,
                watched=watched,
                monitor_trips=monitor_trips,
            )
            # Threads of this process must not hold each other up: one of them stops the valve.
            sys.setswitchinterval(_TURN_OF_A_THREAD_S)
            # To look through all that was imported takes a tenth of a second, again and again.
            gc.collect()
            gc.freeze()
            ending = asyncio.run(_serve(service, socket, group, tell))
            ignore_signals()
        tell(_make_event("ended", exit_code=int(ending.code), reason=ending.reason))
        return ending.code
    finally:
        if announcements is not None:
            announcements.end()


def _make_event(event: str, **details: object) -> dict[str, object]:
    return {"event": event, "time_s": time.time(), **details}


async def _serve(service: RigSession, path: Path, group: str | None, tell: Tell) -> Ending:
    """Answer until a signal comes; then leave the valve safe. A second signal ends it at once."""
    events = asyncio.get_running_loop()
    stop: asyncio.Future[Ending] = events.create_future()
    _listen_for_signals(  # an ending by a signal is the normal one
        lambda number: _stop(stop, service, Ending(ExitCode.OK, f"stopped by {number.name}"))
    )
    server = Server(service)
    await server.listen(path, group)
    watch = _Watch(
        service, tell, partial(events.call_soon_threadsafe, _stop, stop, service, _OWN_ERROR)
    )
    tell(_make_event("listening", socket=str(path), version=__version__))
    watch.start()
    print(f"pamctl daemon: listening on {path}", file=sys.stderr, flush=True)
    notify("READY=1", "STATUS=idle")
    try:
        ending = await stop
        notify("STOPPING=1")
        await server.close()
        await asyncio.to_thread(service.close)
    finally:
        watch.end()
    return _OWN_ERROR if watch.has_failed else ending


def _listen_for_signals(on_end: Callable[[signal.Signals], object]) -> None:
    """Call `on_end` in the running event loop with each signal that asks for an end.

    The event loop's own handlers will not do: it removes them when it closes, and a signal that
    comes then would kill a daemon that is about to end well.
    """
    events = asyncio.get_running_loop()

    def on_signal(number: int, _frame: FrameType | None) -> None:
        if not events.is_closed():
            events.call_soon_threadsafe(on_end, signal.Signals(number))

    for number in STOP_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # ignored under nohup
            signal.signal(number, on_signal)


def _stop(stop: asyncio.Future[Ending], service: RigSession, ending: Ending) -> None:
    if stop.done():
        service.stop_at_once()
    else:
        stop.set_result(ending)
        service.leave()


class _Watch(threading.Thread):
    """Looks after session and run, and feeds the watchdog of the service manager."""

    def __init__(self, service: RigSession, tell: Tell, give_up: Callable[[], object]) -> None:
        super().__init__(name="watch", daemon=True)
        self.has_failed = False
        self._service = service
        self._tell = tell
        self._give_up = give_up
        self._ended = threading.Event()
        self._period_s = watchdog_period_s()
        self._fed_s = 0.0
        self._said: RigState | None = None

    def run(self) -> None:
        try:
            while not self._ended.wait(_LOOK_EVERY_S):
                self._service.look()
                self._report()
        except Exception:
            # Our own fault. Nothing looks after the loop any more: it must not go on.
            traceback.print_exc()
            self.has_failed = True
            self._service.estop()
            self._give_up()

    def _report(self) -> None:
        state = self._service.state
        if state != self._said:
            self._said = state
            notify(f"STATUS={state}")
            self._tell(_make_event("state", state=state, fault=self._service.fault))
        now_s = time.monotonic()
        due_s = self._fed_s + (self._period_s or 0.0) / 4.0
        if self._period_s and now_s >= due_s and self._service.makes_progress():
            self._fed_s = now_s
            notify("WATCHDOG=1")

    def end(self) -> None:
        """Stop looking; return when the thread has ended, or after a moment."""
        self._ended.set()
        self.join(_END_PATIENCE_S)
        if self.is_alive():
            message = f"pamctl daemon: the watch did not end within {_END_PATIENCE_S:g} s"
            print(message, file=sys.stderr, flush=True)


# --- what it tells: events as lines, and signs of life ------------------------------------------

_MOST_WAITING = 1000
_LAST_PATIENCE_S = 1.0


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
