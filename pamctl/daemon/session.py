"""The processes behind the daemon: a loop that takes orders, its guardian, a recorder a run.

    daemon - guardian
           - loop      one for as long as the muscle stays homed
           - recorder  one for each run

The loop sees the daemon's death as the end of a pipe; the guardian sees the loop's.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hal.rig import Rig
from pamctl.base.errors import Ending, ExitCode
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.log.run_meta import RunMeta
from pamctl.processes.backends import new_ring_path
from pamctl.processes.front import LoopTree
from pamctl.processes.loop_supervisor import STARTS_WITHIN_S
from pamctl.processes.run_once import make_run_meta
from pamctl.realtime.orders import SESSION_SLOT_BYTES, OrderError, Orders
from pamctl.recording.recorded_run import LogReport, ProcessRecordedRun
from pamctl.recording.recorder import RecorderError, await_recorder
from pamctl.recording.ring import LoopStage, Ring
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Phase

_ORDER_PATIENCE_S = 2.0
_START_PATIENCE_S = 2.0 * STARTS_WITHIN_S
_LOOP_PATIENCE_S = 30.0
"""Time for what a living loop does within a stop and the release of its device."""
_SESSION_ROWS = 4096
"""Ticks between runs go to no log; clients ask for the newest only."""


@dataclass(frozen=True)
class Workshop:
    """What the sessions of a rig need from it; made by the composition root."""

    rig: Rig
    """Not opened here: made safe when neither loop nor guardian is left to do it."""
    device: str
    """The name of the device."""
    readers: int | None = None
    """Group, by number, that may read the ring of a run: those who may steer; None is nobody."""

    def begin(self, settings: RunSettings, names: Mapping[str, str]) -> Session:
        """Start loop and guardian; raise `RequestRefusedError` if they do not start."""
        return Session(self, settings, names)

    def make_safe(self) -> None:
        """Drive the safe voltage where no loop is left to do it."""
        self.rig.make_safe()


class Session(LoopTree):
    """A living loop, and the current run in it."""

    def __init__(self, workshop: Workshop, settings: RunSettings, names: Mapping[str, str]) -> None:
        """Start loop and guardian; raise `RequestRefusedError` if they do not start."""
        self._workshop = workshop
        self.runs_begun = 0
        meta = make_run_meta(settings, names, Path("/nonexistent"))
        path = new_ring_path().with_suffix(".session")
        self._ring = Ring.create(path, meta, _SESSION_ROWS, slot_bytes=SESSION_SLOT_BYTES)
        self._orders = Orders(self._ring.slot)
        self._open_rings = [self._ring]
        self._failing = ""
        """What the loop did not do in time, and was killed for."""
        self._reading = threading.Lock()
        self._may_signal = threading.Lock()
        """Taken once, by whoever ends the loop."""
        pace = settings.rig.loop
        super().__init__(self._ring, workshop.rig, pace)
        self._await_ticks()
        self._ring.unlink()  # processes that hold it keep it; nothing is left behind

    def _await_ticks(self) -> None:
        deadline_s = time.monotonic() + _START_PATIENCE_S
        while self._ring.latest_tick() is None:
            self.look()
            if self._loop.poll() is not None or time.monotonic() > deadline_s:
                self._loop.kill()
                raise RequestRefusedError(f"the loop did not start: {self.close().reason}")
            time.sleep(2e-3)

    # --- status ---------------------------------------------------------------

    def look(self) -> None:
        """See whether guardian, loop and recorder live; any thread may, every `LOOK_EVERY_S`."""
        with self._reading:
            if self._ring in self._open_rings:
                super().look()

    def latest_tick(self) -> dict[str, float] | None:
        """Return the newest tick's columns by name."""
        with self._reading:
            newest = (ring.latest_tick() for ring in reversed(self._open_rings))
            return next((tick for tick in newest if tick is not None), None)

    def recent_ticks(self, after: int, every: int, most: int) -> list[dict[str, float]]:
        """Return the newest `most` ticks after `after` whose number `every` divides, in order."""
        with self._reading:
            rings = self._open_rings
            ticks = [tick for ring in rings for tick in ring.recent_ticks(after, every, most)]
        return sorted(ticks, key=lambda tick: tick["tick"])[-most:]

    def _close_ring(self, ring: Ring) -> None:
        """Unmap a ring while no thread reads it."""
        with self._reading:
            self._open_rings.remove(ring)
            ring.close()

    @property
    def phase(self) -> Phase | None:
        """Phase of the current run; None before its first tick, and between runs."""
        with self._reading:
            run = self.run
            is_open = run is not None and run.ring in self._open_rings
            tick = run.ring.latest_tick() if run is not None and is_open else None
            return None if tick is None else Phase(int(tick["phase"]))

    @property
    def worst_late_s(self) -> float:
        """The worst wake-up of the current run, or between runs of the session (s)."""
        run = self.run
        with suppress(ValueError):
            return (self._ring if run is None else run.ring).worst_late_ns * 1e-9
        return 0.0

    @property
    def missed_ticks(self) -> int:
        """Ticks missed in the current run, or between runs."""
        run = self.run
        with suppress(ValueError):
            return (self._ring if run is None else run.ring).missed_ticks
        return 0

    @property
    def pids(self) -> dict[str, int]:
        """Process ids, by role."""
        run = {} if self.run is None else {"recorder": self.run.recorder_pid}
        return {"loop": self._loop.pid, **run}

    # --- orders ---------------------------------------------------------------------------

    def order(self, order: Mapping[str, Any]) -> None:
        """Send an order, and return when the loop has taken it.

        Raises `RequestRefusedError` if the loop does not take it.
        """
        try:
            self._orders.give(order, _ORDER_PATIENCE_S, lambda: self.is_alive)
        except OrderError as error:
            why = str(error) if self.is_alive else f"{error}; `pamctl status` says why"
            raise RequestRefusedError(why) from error

    def begin(self, name: str, meta: RunMeta, rows: int, course: bytes) -> None:
        """Begin a run with its own log, on a course that is packed for the loop.

        Raises `RequestRefusedError` if the log cannot be written.
        """
        ring = Ring.create(new_ring_path(), meta, rows, course)
        if self._workshop.readers is not None:
            ring.admit_readers(self._workshop.readers)
        self._open_rings.append(ring)
        run = ProcessRecordedRun(name, ring)
        ring.loop_stage = LoopStage.SETTING_UP
        before, self.run = self.run, run
        self.runs_begun += 1
        try:
            await_recorder(ring, run.recorder)
            # The settings are long, and the loop needs none of them.
            short = replace(meta, config={}, attachments={}, metadata={}).to_text().decode()
            self.order({"do": "run", "ring": str(ring.path), "meta": short})
        except (RecorderError, RequestRefusedError) as error:
            self.run = before
            run.finish(Ending(ExitCode.UNEXPECTED, str(error)))
            if not ring.head:
                run.log.unlink(missing_ok=True)  # it holds no tick
            self._close_ring(ring)
            raise RequestRefusedError(str(error)) from error
        if before is not None:
            self._wait_for_loop("end the run before this one", lambda: before.is_over)
            self._finish(before, Ending(ExitCode.OK, "another run has begun"))

    def stop_now(self) -> None:
        """Demand the emergency stop; the loop ends."""
        with suppress(ValueError):  # the loop has just ended
            self._orders.stop_now()

    # --- ends -------------------------------------------------------------------------------

    def finish_run(self) -> LogReport | None:
        """Finish the log of a run that is over; wait for its recorder."""
        return None if self.run is None else self._finish(self.run, Ending(ExitCode.OK, ""))

    def _wait_for_loop(self, what: str, is_done: Callable[[], bool]) -> None:
        """Wait until the loop has done something, or is dead; kill one that does not do it."""
        deadline_s = time.monotonic() + _LOOP_PATIENCE_S
        while self.is_alive and not is_done():
            self.look()
            if time.monotonic() > deadline_s and not self._failing:
                self._failing = f"the loop did not {what} within {_LOOP_PATIENCE_S:g} s"
                self._loop.kill()
            time.sleep(5e-3)

    def _finish(self, run: ProcessRecordedRun, ending: Ending) -> LogReport:
        report = run.finish(ending)
        if self.run is run:
            self.run = None  # only now: its log is whole
        self._close_ring(run.ring)
        return report

    def begin_end(self) -> None:
        """Begin to end the loop smoothly; return at once. Any thread may call it, any often."""
        # A second signal would cut the smooth stop short.
        if self._may_signal.acquire(blocking=False):
            self.send_signal(signal.SIGTERM)

    def close(self) -> Ending:
        """End the loop smoothly if it lives; return how it ended. The valve is safe afterwards."""
        self.begin_end()
        self._wait_for_loop("end", lambda: False)
        ending, _ = self.conclude(self._failing)
        run, self.run = self.run, None
        if run is not None:
            self._close_ring(run.ring)
        self._ring.unlink()
        self._orders.close()
        self._close_ring(self._ring)
        return ending
