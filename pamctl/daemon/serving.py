"""The daemon while it is up: the server, and the watch over session and run."""

from __future__ import annotations

import asyncio
import gc
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from pamctl import __version__
from pamctl.daemon.announcements import Announcements, notify, watchdog_period_s
from pamctl.daemon.protocol import methods_of
from pamctl.daemon.rig_session import RigSession
from pamctl.daemon.server import Server, find_group, require_no_daemon
from pamctl.daemon.session import Workshop
from pamctl.daemon.session_life import RigState
from pamctl.daemon.shelf import Latch, Shelf
from pamctl.exit_codes import Ending, ExitCode
from pamctl.plant.model import PlantSettings
from pamctl.processes.backends import (
    SHARED_MEMORY,
    device_of,
    require_backend,
    require_open_files,
    secure_device,
)
from pamctl.processes.interrupts import STOP_SIGNALS
from pamctl.processes.keep_awake import keep_awake
from pamctl.processes.run_once import build_machine_code
from pamctl.recording.recorder import finish_orphans, ignore_signals
from pamctl.settings.resolve import RunSettings

_LOOK_EVERY_S = 5e-3
_TURN_OF_A_THREAD_S = 5e-4
_END_PATIENCE_S = 10.0
_OWN_ERROR = Ending(ExitCode.UNEXPECTED, "an error of the daemon's own")

Tell = Callable[[Mapping[str, object]], object]


class ServiceOptions(NamedTuple):
    """What the command line says beside the settings."""

    socket: Path
    group: str | None
    """Group that may steer, beside this user."""
    logs: Path
    keep: int | None
    """Number of the daemon's logs to keep; None keeps all."""
    idle_after_s: float
    announce: bool
    """Print each event as a line of JSON."""
    file_gains: Mapping[str, Any]
    """Those of the file that the controller is named after."""
    watched: PlantSettings | None = None
    """Plant that the monitor compares every run with; None starts no monitor."""
    monitor_trips: bool = False
    """An alarm of the monitor is an emergency stop."""


def serve_daemon(
    settings: RunSettings, names: Mapping[str, str], options: ServiceOptions
) -> ExitCode:
    """Hold the device and do what clients ask until a signal comes; return how it ended.

    Raises `ShelfError` where logs cannot be written, `RigError`, `RingError` or `SocketError`
    where the device or the socket cannot be had.
    """
    # First: whoever starts a second daemon wants to hear of the first, not of its device.
    require_no_daemon(options.socket)
    shelf = Shelf(options.logs, options.keep)
    announcements = Announcements(sys.stdout.fileno()) if options.announce else None
    tell: Tell = _announce_nothing if announcements is None else announcements.put
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
                Workshop(device, device_of(settings.rig), find_group(options.group)),
                shelf,
                Latch(SHARED_MEMORY / f"pamctl-{device_of(settings.rig)}.fault"),
                file_gains=options.file_gains,
                idle_after_s=options.idle_after_s,
                tell=tell,
                watched=options.watched,
                monitor_trips=options.monitor_trips,
            )
            _shorten_pauses()
            ending = asyncio.run(_serve(service, options.socket, options.group, tell))
            ignore_signals()
        tell(_make_event("ended", exit_code=int(ending.code), reason=ending.reason))
        return ending.code
    finally:
        if announcements is not None:
            announcements.end()


def _shorten_pauses() -> None:
    """Keep the threads of this process from holding each other up: one of them stops the valve."""
    sys.setswitchinterval(_TURN_OF_A_THREAD_S)
    gc.collect()
    gc.freeze()  # to look through all that was imported takes a tenth of a second, again and again


def _announce_nothing(event: Mapping[str, object]) -> None:
    """Drop the event: nobody asked for events."""


def _make_event(event: str, **details: object) -> dict[str, object]:
    return {"event": event, "time_s": time.time(), **details}


async def _serve(service: RigSession, path: Path, group: str | None, tell: Tell) -> Ending:
    """Answer until a signal comes; then leave the valve safe. A second signal ends it at once."""
    events = asyncio.get_running_loop()
    stop: asyncio.Future[Ending] = events.create_future()
    _listen_for_signals(lambda number: _stop(stop, service, _make_signal_ending(number)))
    server = Server(methods_of(service))
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


def _make_signal_ending(number: signal.Signals) -> Ending:
    """Return the ending by a signal, which is the normal one: exit code 0."""
    return Ending(ExitCode.OK, f"stopped by {number.name}")


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
