"""A session's loop in this process, on the simulated rig, that ticks only when asked to.

The caller gives an order and a goal; the loop ticks until the goal is reached. Between two orders
no time passes on the rig.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

from pamctl.base.errors import EMERGENCY_STOP, Ending, ExitCode
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.log.run_meta import RunMeta
from pamctl.processes.backends import new_ring_path, require_backend
from pamctl.processes.loop_main import compose_loop
from pamctl.processes.run_once import make_run_meta
from pamctl.recording.journal import SessionJournal, wait_for_recorder
from pamctl.recording.recorded_run import LogReport, ThreadRecordedRun
from pamctl.recording.recorder import RecorderError
from pamctl.recording.ring import Ring, RingError
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Phase

_SESSION_ROWS = 256
_NEVER = lambda: False  # noqa: E731


@contextmanager
def hold_back_ctrl_c() -> Iterator[list[tuple[int, FrameType | None]]]:
    """Obey Ctrl-C after the block, not within it. Only the main thread gets it, and so waits.

    The block is given a list that is empty until Ctrl-C comes.
    """
    before = signal.getsignal(signal.SIGINT)
    came: list[tuple[int, FrameType | None]] = []
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield came
        return
    signal.signal(signal.SIGINT, lambda number, frame: came.append((number, frame)))
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            before(*came[0])


class InProcessMaker:
    """How a simulated rig's loop is started."""

    device = "simulated here"

    def begin(self, settings: RunSettings, names: Mapping[str, str]) -> InProcessLoop:
        """Start a loop, from the vented muscle on."""
        return InProcessLoop(settings, names)

    def make_safe(self) -> None:
        """Do nothing: without a loop there is no valve."""


class InProcessLoop:
    """A loop and its plant, from the vented muscle on; carries a `RigSession`."""

    worst_late_s, missed_ticks = 0.0, 0

    def __init__(self, settings: RunSettings, names: Mapping[str, str]) -> None:
        """Begin parked and not homed."""
        require_backend(settings.rig)
        self._settings = settings
        self.run: ThreadRecordedRun | None = None
        self.runs_begun = 0
        self.pids: dict[str, int] = {}
        self._ending: Ending | None = None
        self._order: Mapping[str, Any] | None = None
        self._turn = threading.RLock()
        """Held by the thread that lets time pass."""
        self._wants_abort = self._is_leaving = False
        meta = make_run_meta(settings, names, Path("/nonexistent"))
        self._ring = Ring.in_memory(meta, _SESSION_ROWS)
        self._journal = SessionJournal(
            self._ring, lambda ring: None if ring is None else wait_for_recorder(ring)
        )
        self._loop = compose_loop(settings, self._journal, self, orders=self)
        self._ticks = self._loop.run_in_steps()
        with hold_back_ctrl_c():
            self._tick_once()

    # --- what it tells --------------------------------------------------------------------------

    @property
    def is_alive(self) -> bool:
        """The loop has not ended."""
        return self._ending is None

    has_loop = is_alive

    @property
    def log(self) -> str | None:
        """The log that the ticks go into; None between runs."""
        ring = self._journal.run
        return None if ring is None else ring.meta.log_path

    @property
    def tick(self) -> dict[str, float]:
        """The newest tick's columns by name."""
        return self._ring.read_tick(self._loop.tick.row)

    def latest_tick(self) -> dict[str, float]:
        """Return the newest tick's columns by name."""
        return self.tick

    def recent_ticks(self, after: int, every: int, most: int) -> list[dict[str, float]]:
        """Return the newest `most` ticks after `after` whose number `every` divides, in order."""
        rings = [self._ring] if self.run is None else [self._ring, self.run.ring]
        ticks = [tick for ring in rings for tick in ring.recent_ticks(after, every, most)]
        return sorted(ticks, key=lambda tick: tick["tick"])[-most:]

    @property
    def phase(self) -> Phase | None:
        """Phase of the current run; None before its first tick, and between runs."""
        is_recorded = self.run is not None and self.log == self.run.ring.meta.log_path
        tick = self.run.ring.latest_tick() if self.run is not None and is_recorded else None
        return None if tick is None else Phase(int(tick["phase"]))

    # --- orders ---------------------------------------------------------------------------------

    def advance(self, goal: Callable[[], bool], order: Mapping[str, Any] | None = None) -> None:
        """Obey an order, and tick until the goal is reached or the loop has ended.

        Ctrl-C stops the time, not the run.
        """
        with hold_back_ctrl_c() as pressed:
            self._advance_whole(lambda: bool(pressed) or goal(), order)

    def _advance_whole(
        self, goal: Callable[[], bool], order: Mapping[str, Any] | None = None
    ) -> None:
        with self._turn:
            self._order = order
            while self._ending is None:
                self._tick_once()
                if self._order is None and goal():
                    return

    def _tick_once(self) -> None:
        try:
            if self._order is not None:
                self._loop.settle()
            next(self._ticks)
        except StopIteration as end:
            self._end(end.value)
        except RingError as error:  # the log could not be written
            self._end(Ending(ExitCode.UNEXPECTED, str(error)))
        except Exception as error:
            self._ticks.close()
            self._end(Ending(ExitCode.UNEXPECTED, f"{type(error).__name__}: {error}"))
            raise

    def _end(self, ending: Ending) -> None:
        self._journal.end_last_run(ending)
        self._ending = ending

    def order(self, order: Mapping[str, Any]) -> None:
        """Return when the loop has taken an order."""
        self.advance(lambda: True, order)
        if self._ending is not None:
            raise RequestRefusedError(f"the loop has ended: {self._ending.reason}")

    @hold_back_ctrl_c()
    def begin(self, name: str, meta: RunMeta, rows: int, course: bytes) -> None:
        """Begin a run with its own log."""
        ring = Ring.create(new_ring_path(), meta, rows, course)
        try:
            run = ThreadRecordedRun(name, ring)
        except RecorderError as error:
            raise RequestRefusedError(str(error)) from error
        before, self.run = self.run, run
        self.runs_begun += 1
        short = replace(meta, config={}, attachments={}, metadata={}).to_text().decode()
        path = ring.meta.log_path
        order = {"do": "run", "ring": str(ring.path), "meta": short}
        self._advance_whole(lambda: self.log == path, order)
        if before is not None:
            _finish(before, Ending(ExitCode.OK, "another run has begun"))

    def look(self) -> None:
        """Let a loop end that shall end at once."""
        if self._wants_abort:
            self.advance(_NEVER)

    def stop_now(self) -> None:
        """Demand the emergency stop; the loop ends with its next tick."""
        self._wants_abort = True

    @hold_back_ctrl_c()
    def finish_run(self) -> LogReport | None:
        """Finish the log of a run that is over; raise `RecorderError` if it is not whole."""
        run, self.run = self.run, None
        return None if run is None else _finish(run, self._ending or Ending(ExitCode.OK, ""))

    def begin_end(self) -> None:
        """Let the loop end smoothly from its next tick on."""
        self._is_leaving = True

    @hold_back_ctrl_c()
    def close(self) -> Ending:
        """End the loop; return how it ended."""
        self.begin_end()
        self._advance_whole(_NEVER)
        assert self._ending is not None
        self.finish_run()
        self._ring.close()
        return self._ending

    # --- the loop's side ------------------------------------------------------------------------

    def take(self) -> dict[str, Any] | None:
        """Return the next order; the loop asks after every tick."""
        order, self._order = self._order, None
        return None if order is None else dict(order)

    def find_stop(self, tick: int) -> Ending | None:
        """Return the ending once the loop shall end."""
        if self._wants_abort:
            return Ending(ExitCode.SAFETY_TRIP, EMERGENCY_STOP)
        return Ending(ExitCode.OK, "the session ended") if self._is_leaving else None

    def wants_abort(self) -> bool:
        """Tell whether to skip the smooth stop."""
        return self._wants_abort


def _finish(run: ThreadRecordedRun, ending: Ending) -> LogReport:
    report = run.finish(ending)
    run.ring.close()
    if not report.log_is_whole:
        raise RecorderError(report.note or report.ending.reason)
    return report
