"""The daemon's loop on the simulated rig, in a thread that runs only while it is asked to.

The caller gives an order and a goal, and waits; the loop ticks until the goal is reached, and
then waits for the next order. One of the two threads works at a time. Between two orders no time
passes on the rig.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

from pamctl.exit_codes import EMERGENCY_STOP, Ending, ExitCode
from pamctl.log.run_meta import bare_name, make_dated_path
from pamctl.processes.backends import build_clock, build_rig, require_backend
from pamctl.processes.run_once import make_run_meta, new_ring_path
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.steering import SteeredProgram
from pamctl.recording.drain import record_run
from pamctl.recording.journal import SessionJournal, wait_for_recorder
from pamctl.recording.ring import RecorderFlag, Ring, RingError, RingFull
from pamctl.session.held_ctrl_c import hold_back_ctrl_c
from pamctl.settings.build import build_ordered_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Phase

_SESSION_ROWS = 256
_RUN_ROWS = 4096
_NAMING = threading.Lock()
"""Held from the choice of a log's name until the file exists: rigs may share a folder."""

Order = Mapping[str, Any]
Goal = Callable[["SimulatedLoop"], bool]
"""Is asked after every tick whether the caller's wish is met."""


class _Task(NamedTuple):
    order: Order | None
    goal: Goal


class SimulatedLoop:
    """A loop and its plant, from the vented muscle on; `ending` says that it is over."""

    def __init__(self, settings: RunSettings, names: Mapping[str, str], logs: Path) -> None:
        """Begin parked and not homed; the logs go into the folder `logs`."""
        require_backend(settings)
        self._settings, self._names, self._logs = settings, names, logs
        self.ending: Ending | None = None
        self.run_path: Path | None = None
        """The log of the current run; None between runs."""
        self._last: bytes | None = None
        self._tasks: SimpleQueue[_Task | None] = SimpleQueue()
        self._done: SimpleQueue[None] = SimpleQueue()
        self._goal: Goal | None = None
        self._wants_turn = self._wants_abort = self._is_leaving = False
        self._recorder: _RunRecorder | None = None
        self._failure: BaseException | None = None
        meta = make_run_meta(settings, names, Path("/nonexistent"))
        self._ring = Ring.create(new_ring_path().with_suffix(".session"), meta, _SESSION_ROWS)
        self._ring.unlink()
        self._journal = _TickedJournal(self._ring, self)
        self._thread = threading.Thread(target=self._work, name="simulated loop", daemon=True)
        self._thread.start()
        with hold_back_ctrl_c():
            self._await_turn()

    # --- the caller's side ----------------------------------------------------------------------

    def advance(self, goal: Goal, order: Order | None = None) -> None:
        """Obey an order, and tick until the goal is reached or the loop has ended.

        An exception in the caller's thread, such as Ctrl-C, stops the time, not the run.
        """
        if self.ending is not None:
            return
        self._wants_turn = False
        self._tasks.put(_Task(order, goal))
        self._await_turn()

    @hold_back_ctrl_c()
    def begin_run(self, order: Order, settings: RunSettings, name: str) -> Path:
        """Begin a run with its own log and return its path.

        Raises `RingError` or `LogError` where it cannot be written.
        """
        with _NAMING:
            path = make_dated_path(self._logs, f"{bare_name(self._names['controller'])}-{name}")
            meta = make_run_meta(settings, {**self._names, "experiment": name}, path)
            recorder = _RunRecorder(Ring.create(new_ring_path(), meta, _RUN_ROWS))
        before, self._recorder, self.run_path = self._recorder, recorder, path
        self.advance(lambda loop: loop.is_recording(path), {**order, "ring": str(recorder.path)})
        if before is not None:
            before.finish()
        if self.ending is not None:
            self.finish_run()
        return path

    def is_recording(self, path: Path) -> bool:
        """Return whether the ticks go into this log; for goals."""
        run = self._journal.run
        return run is not None and Path(run.meta.log_path) == path.absolute()

    @property
    def is_running(self) -> bool:
        """Whether the ticks go into a log."""
        return self._journal.run is not None

    @hold_back_ctrl_c()
    def finish_run(self) -> None:
        """Wait until the log of a run that is over is whole."""
        recorder, self._recorder, self.run_path = self._recorder, None, None
        if recorder is not None:
            recorder.finish()

    def note_tick(self, row: bytearray) -> None:
        """Take note of the newest tick, a row of the ring."""
        self._last = bytes(row)

    @property
    def last(self) -> dict[str, float] | None:
        """The newest tick's columns by name."""
        return None if self._last is None else self._ring.read_tick(self._last)

    @hold_back_ctrl_c()
    def close(self, *, at_once: bool = False) -> Ending:
        """End the loop: smoothly, or `at_once` at the safe voltage. Return how it ended."""
        self._wants_abort = at_once
        self._is_leaving = True
        self.advance(lambda loop: False)
        assert self.ending is not None
        self.finish_run()
        if self._thread.is_alive():
            self._thread.join()
            self._ring.close()
        return self.ending

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

    # --- the loop's side ------------------------------------------------------------------------

    def take(self) -> Order | None:
        """Return the next order; the loop asks after every tick."""
        if self._goal is not None and not (self._wants_turn or self._goal(self)):
            return None
        self._goal = None
        self._done.put(None)
        task = self._tasks.get()
        assert task is not None
        self._goal = task.goal
        return task.order

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
            ending = self._run()
        except RingError as error:  # the log could not be written
            ending = Ending(ExitCode.UNEXPECTED, str(error))
        except Exception as error:
            self._failure = error
            ending = Ending(ExitCode.UNEXPECTED, f"{type(error).__name__}: {error}")
        try:
            self._journal.end_last_run(ending)
        except RingFull as error:
            ending = Ending(ExitCode.UNEXPECTED, str(error))
        self.ending = ending
        self._done.put(None)

    def _run(self) -> Ending:
        settings = self._settings
        setup = build_tick_setup(settings)
        start = {"event": "timing_setup", "mode": "fast: no clock"}
        self._journal.put_event(0, self._ring.meta.start_mono_ns, start)
        parts = build_rig(settings, build_clock(settings, may_spin=False))
        steered = SteeredProgram(
            _TickOrders(self),
            self._journal,
            setup,
            settings.controller.model_dump(mode="json"),
            partial(build_ordered_program, settings),
        )
        return ControlLoop(
            rig=parts.rig,
            clock=parts.clock,
            setup=setup,
            nominal_zero=nominal_zero_of(settings),
            program=steered,
            journal=self._journal,
            supervisor=self,
            truth=parts.truth,
            helm=steered,
        ).run()


class _TickOrders:
    """The slot of orders, as the steered program asks for them."""

    def __init__(self, loop: SimulatedLoop) -> None:
        self._loop = loop

    def take(self) -> dict[str, Any] | None:
        order = self._loop.take()
        return None if order is None else dict(order)


class _TickedJournal(SessionJournal):
    """Tells its loop of each tick; the rings of runs wait for their recorders."""

    def __init__(self, session: Ring, loop: SimulatedLoop) -> None:
        super().__init__(session, lambda ring: None if ring is None else wait_for_recorder(ring))
        self._loop = loop

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        self._loop.note_tick(row)
        super().put_row(row, late_s, missed)


class _RunRecorder:
    """Writes the log of a run in a thread; as the owner of the recording it never leaves."""

    def __init__(self, ring: Ring) -> None:
        """Open the log; raise `LogError` where it cannot be written."""
        self._ring = ring
        self._failure: Exception | None = None
        self._is_over = threading.Event()
        self._is_ready = threading.Event()
        self._thread = threading.Thread(target=self._record, name="recorder", daemon=True)
        self._thread.start()
        while not (ring.recorder_flags & RecorderFlag.READY or self._failure):
            self._is_ready.wait(1e-3)
        if self._failure is not None:
            self.finish()

    gone = False

    @property
    def path(self) -> Path:
        return self._ring.path

    def wait(self, seconds: float) -> None:
        """Sleep between two looks into the ring, or until the run is over."""
        self._is_over.wait(seconds)

    def finish(self) -> None:
        """Return when the log is whole; raise what kept it from being written."""
        self._ring.loop_done = 1
        self._is_over.set()
        self._thread.join()
        self._ring.unlink()
        self._ring.close()
        if self._failure is not None:
            raise self._failure

    def _record(self) -> None:
        try:
            record_run(self._ring, self)
        except Exception as error:
            self._failure = error
            self._ring.raise_flag(RecorderFlag.FAILED)


def is_at_rest_at(position_m: float) -> Goal:
    """Return the goal of a motion to a held position."""

    def has_arrived(loop: SimulatedLoop) -> bool:
        last = loop.last
        if last is None or not loop.is_running:
            return not loop.is_running
        is_there = math.isclose(last["reference_m"], position_m, abs_tol=1e-9)
        return is_there and is_resting(last)

    return has_arrived


def is_resting(tick: Mapping[str, float]) -> bool:
    """Return whether a position is held."""
    return tick["phase"] == Phase.REST
