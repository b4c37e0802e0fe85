"""A session's loop in this process, on the simulated rig, in a thread that runs only when asked to.

The caller gives an order and a goal, and waits; the loop ticks until the goal is reached, and
then waits for the next order. One of the two threads works at a time. Between two orders no time
passes on the rig.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Any

from pamctl.daemon.protocol import RequestRefusedError
from pamctl.exit_codes import EMERGENCY_STOP, Ending, ExitCode
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
        self._failure: BaseException | None = None
        self._last: bytes | None = None
        self._orders: SimpleQueue[Mapping[str, Any] | None] = SimpleQueue()
        self._done: SimpleQueue[None] = SimpleQueue()
        self._turn = threading.RLock()
        """Held by the thread that lets time pass."""
        self._goal: Callable[[], bool] | None = None
        self._wants_turn = self._wants_abort = self._is_leaving = False
        meta = make_run_meta(settings, names, Path("/nonexistent"))
        self._ring = Ring.in_memory(meta, _SESSION_ROWS)
        self._journal = _TickedJournal(self._ring, self)
        self._thread = threading.Thread(target=self._work, name="simulated loop", daemon=True)
        self._thread.start()
        with hold_back_ctrl_c():
            self._await_turn()

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
    def tick(self) -> dict[str, float] | None:
        """The newest tick's columns by name."""
        return None if self._last is None else self._ring.read_tick(self._last)

    def latest_tick(self) -> dict[str, float] | None:
        """Return the newest tick's columns by name."""
        return self.tick

    def recent_ticks(self, after: int, every: int, most: int) -> list[dict[str, float]]:
        """Return the newest `most` ticks after `after` whose number `every` divides, in order."""
        rings = [self._ring] if self.run is None else [self._ring, self.run.ring]
        ticks = [tick for ring in rings for tick in ring.recent_ticks(after, every, most)]
        return sorted(ticks, key=lambda tick: tick["tick"])[-most:]

    @property
    def phase(self) -> Phase | None:
        """Phase of the current run."""
        is_recorded = self.run is not None and self.log == self.run.ring.meta.log_path
        tick = self.tick if is_recorded else None
        return None if tick is None else Phase(int(tick["phase"]))

    # --- orders ---------------------------------------------------------------------------------

    def advance(self, goal: Callable[[], bool], order: Mapping[str, Any] | None = None) -> None:
        """Obey an order, and tick until the goal is reached or the loop has ended.

        An exception in the caller's thread, such as Ctrl-C, stops the time, not the run.
        """
        # Ctrl-C just after the turn has come would be taken for one that came while it was awaited.
        with self._turn, hold_back_ctrl_c() as pressed:
            self._advance_whole(lambda: bool(pressed) or goal(), order)

    def _advance_whole(
        self, goal: Callable[[], bool], order: Mapping[str, Any] | None = None
    ) -> None:
        with self._turn:
            if self._ending is None:
                self._wants_turn, self._goal = False, goal
                self._orders.put(order)
                self._await_turn()

    def _await_turn(self) -> None:
        try:
            self._done.get()
        except BaseException:
            self._wants_turn = True
            self._done.get()
            raise
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

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
        if self._thread.is_alive():
            self._thread.join()
            self._ring.close()
        return self._ending

    # --- the loop's side ------------------------------------------------------------------------

    def take(self) -> dict[str, Any] | None:
        """Return the next order; the loop asks after every tick."""
        if self._goal is not None and not (self._wants_turn or self._goal()):
            return None
        self._goal = None
        self._done.put(None)
        order = self._orders.get()
        return None if order is None else dict(order)

    def note_tick(self, row: bytearray) -> None:
        """Take note of the newest tick, a row of the ring."""
        self._last = bytes(row)

    def find_stop(self, tick: int) -> Ending | None:
        """Return the ending once the loop shall end."""
        if self._wants_abort:
            return Ending(ExitCode.SAFETY_TRIP, EMERGENCY_STOP)
        return Ending(ExitCode.OK, "the session ended") if self._is_leaving else None

    def wants_abort(self) -> bool:
        """Tell whether to skip the smooth stop."""
        return self._wants_abort

    def _work(self) -> None:
        try:
            ending = compose_loop(self._settings, self._journal, self, orders=self).run()
        except RingError as error:  # the log could not be written
            ending = Ending(ExitCode.UNEXPECTED, str(error))
        except Exception as error:
            self._failure = error
            ending = Ending(ExitCode.UNEXPECTED, f"{type(error).__name__}: {error}")
        self._journal.end_last_run(ending)
        self._ending = ending
        self._done.put(None)


class _TickedJournal(SessionJournal):
    """Tells its loop of each tick; the rings of runs wait for their recorders."""

    def __init__(self, session: Ring, loop: InProcessLoop) -> None:
        super().__init__(session, lambda ring: None if ring is None else wait_for_recorder(ring))
        self._loop = loop

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        self._loop.note_tick(row)
        super().put_row(row, late_s, missed)


def _finish(run: ThreadRecordedRun, ending: Ending) -> LogReport:
    report = run.finish(ending)
    run.ring.close()
    if not report.log_is_whole:
        raise RecorderError(report.note or report.ending.reason)
    return report
