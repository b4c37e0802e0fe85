"""What `pamctl daemon` is while it is up: the server, the watch over session and run.

Apart from the verb, so that no other verb has to wait for it.
"""

from __future__ import annotations

import asyncio
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from hal.rig import Rig, RigError
from pamctl.cli.assembly import SHARED_MEMORY, device_of, require_backend
from pamctl.cli.live import live_view
from pamctl.cli.running import finish_orphans, ring_path, run_meta, secured
from pamctl.daemon.latch import Latch
from pamctl.daemon.methods import methods_of
from pamctl.daemon.notify import notify, watchdog_period_s
from pamctl.daemon.server import Server, SocketError
from pamctl.daemon.service import Service
from pamctl.daemon.session import Workshop
from pamctl.daemon.shelf import Shelf
from pamctl.realtime.ending import ExitCode
from pamctl.realtime.ring import RingError
from pamctl.settings import RunSettings

_LOOK_EVERY_S = 5e-3


class ServiceOptions(NamedTuple):
    """What the command line says beside the settings."""

    socket: Path
    group: str | None
    logs: Path
    keep: int | None
    idle_after_s: float
    live_port: int | None
    live_origins: Sequence[str]


def serve(settings: RunSettings, names: Mapping[str, str], options: ServiceOptions) -> ExitCode:
    """Hold the device and do what clients ask until a signal comes; return how it ended."""
    try:
        require_backend(settings)
        shelf = Shelf(options.logs, options.keep)
        with secured(settings) as device:
            finish_orphans(quiet=False)
            service = Service(
                settings,
                names,
                _workshop(settings, device),
                shelf,
                Latch(SHARED_MEMORY / f"pamctl-{device_of(settings)}.fault"),
                idle_after_s=options.idle_after_s,
            )
            live = live_view(
                options.live_port, options.live_origins, "--socket", str(options.socket)
            )
            with live:
                return asyncio.run(_serve(service, options.socket, options.group))
    except (SocketError, RingError, RigError) as error:
        print(f"error: {error}", file=sys.stderr)
        return ExitCode.UNAVAILABLE
    except OSError as error:
        print(f"error: --logs {options.logs}: {error.strerror or error}", file=sys.stderr)
        return ExitCode.USAGE


def _workshop(settings: RunSettings, rig: Rig) -> Workshop:
    start = [sys.executable, "-m"]
    return Workshop(
        loop=[*start, "pamctl.cli.session_process"],
        guardian=[*start, "pamctl.cli.guardian_process"],
        rig=rig,
        meta=run_meta,
        device=device_of(settings),
        ring_path=ring_path,
    )


async def _serve(service: Service, path: Path, group: str | None) -> ExitCode:
    """Answer until a signal comes; then leave the valve safe. A second signal hurries it."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, partial(_stop, stop, service))
    server = await Server(methods_of(service)).listen(path, group)
    watch = _Watch(service, partial(asyncio.get_running_loop().call_soon_threadsafe, stop.set))
    watch.start()
    print(f"pamctl daemon: listening on {path}", file=sys.stderr, flush=True)
    notify("READY=1", "STATUS=idle")
    try:
        await stop.wait()
        notify("STOPPING=1")
        server.close()
        await asyncio.to_thread(service.close)
    finally:
        watch.end()
        path.unlink(missing_ok=True)
    return ExitCode.UNEXPECTED if watch.has_failed else ExitCode.OK


def _stop(stop: asyncio.Event, service: Service) -> None:
    if stop.is_set():
        service.estop()
    stop.set()


class _Watch(threading.Thread):
    """Looks after session and run, and tells the service manager that there is progress."""

    def __init__(self, service: Service, give_up: Callable[[], object]) -> None:
        super().__init__(name="watch", daemon=True)
        self.has_failed = False
        self._service = service
        self._give_up = give_up
        self._ended = threading.Event()
        self._period_s = watchdog_period_s()
        self._fed_s = 0.0
        self._said = ""

    def run(self) -> None:
        try:
            while not self._ended.wait(_LOOK_EVERY_S):
                self._service.look()
                self._report()
        except Exception:
            # An error of ours. Nobody looks after the loop any more: it must not go on.
            traceback.print_exc()
            self.has_failed = True
            self._service.estop()
            self._give_up()

    def _report(self) -> None:
        state = str(self._service.state)
        if state != self._said:
            self._said = state
            notify(f"STATUS={state}")
        now_s = time.monotonic()
        due_s = self._fed_s + (self._period_s or 0.0) / 4.0
        if self._period_s and now_s >= due_s and self._service.makes_progress():
            self._fed_s = now_s
            notify("WATCHDOG=1")

    def end(self) -> None:
        """Look no more."""
        self._ended.set()
        self.join()
