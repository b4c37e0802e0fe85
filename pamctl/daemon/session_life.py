"""The states of a session, and the life of its loop.

The loop runs in a carrier: processes of its own (`session.py`), or this process, for a simulation
without a clock (`in_process.py`). What it can be asked is in `rig_session.py`.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from pamctl.base.errors import Ending, ExitCode
from pamctl.daemon.protocol import Order, OrderTaker, RequestRefusedError

if TYPE_CHECKING:
    from pamctl.daemon.in_process import InProcessLoop, InProcessMaker
    from pamctl.daemon.session import Session, Workshop
    from pamctl.daemon.shelf import Latch, Shelf
    from pamctl.log.run_meta import Annotation
    from pamctl.plant.model import PlantSettings
    from pamctl.processes.interrupts import SleepInhibitor
    from pamctl.recording.recorded_run import RecordedRun
    from pamctl.settings.resolve import RunSettings

    Carrier: TypeAlias = Session | InProcessLoop
    """A living loop, and the current run in it."""

_RECENT_EVENTS = 50


class RigState(StrEnum):
    """States of a session."""

    IDLE = "idle"
    """Nothing runs, and the valve is safe."""
    HOMING = "homing"
    READY = "ready"
    """Homed, and parked at the safe voltage or holding a position."""
    RUNNING = "running"
    STOPPING = "stopping"
    FAULT = "fault"
    """Until it is acknowledged."""


class _Row(NamedTuple):
    takes: frozenset[str]
    leads_to: frozenset[str]


def _row(takes: str, leads_to: str) -> _Row:
    return _Row(frozenset(takes.split()), frozenset(leads_to.split()))


STATES: Mapping[RigState, _Row] = {
    # state           orders that it takes   states that may follow
    RigState.IDLE: _row("start goto", "homing running ready fault"),
    RigState.HOMING: _row("", "running ready stopping idle fault"),
    RigState.READY: _row("start goto", "homing running stopping idle fault"),
    RigState.RUNNING: _row("goto", "ready stopping idle fault"),
    RigState.STOPPING: _row("", "ready running idle fault"),
    RigState.FAULT: _row("ack", "idle"),
}
"""The state machine. Orders that it does not name are taken in every state, if they can be met.

A held position counts as ready once it is reached; a session without homing never is homing. A
position that is left for another one is running meanwhile, which is why `goto` is taken then.
"""


class SessionLife(OrderTaker):
    """One rig, for as long as its daemon or its simulation lives: states, runs, faults."""

    def __init__(
        self,
        settings: RunSettings,
        names: Mapping[str, str],
        maker: Workshop | InProcessMaker,
        shelf: Shelf,
        latch: Latch,
        *,
        file_gains: Mapping[str, Any] | None = None,
        idle_after_s: float = 600.0,
        tell: Callable[[Mapping[str, object]], object] = lambda event: None,
        watched: PlantSettings | None = None,
        monitor_trips: bool = False,
    ) -> None:
        """`settings` says rig, plant and the first gains; its experiment is not run.

        `file_gains` are those of the file that the controller is named after; by default the first.

        A loop that is parked for `idle_after_s` ends. `tell` is called with every event, from
        any thread, and must not wait for anything. A fault that `latch` kept from before must be
        acknowledged first. A monitor follows every run against the plant `watched`; its alarm is
        an emergency stop where `monitor_trips`.
        """
        from pamctl.daemon.monitor_handle import MonitorHandle
        from pamctl.daemon.requested_settings import GainHistory
        from pamctl.settings.resolve import settings_to_data

        self._settings = settings
        self._names = dict(names)
        self._file_gains = file_gains or settings_to_data(settings.controller)
        self._maker = maker
        self._shelf = shelf
        self._latch = latch
        self._idle_after_s = idle_after_s
        self._carrier: Carrier | None = None
        self._inhibitor: SleepInhibitor | None = None
        self._holds = False
        self.run_has_end = True
        """Whether the current run ends by itself."""
        self._stopping: RecordedRun | None = None
        self._parked_since_s = 0.0
        self._began_s = time.monotonic()
        self._busy = threading.RLock()
        self._seen_tick = -1
        self._is_leaving = False
        self._tell = tell
        self.events: deque[dict[str, Any]] = deque(maxlen=_RECENT_EVENTS)
        self._gain_history = GainHistory()
        self._monitor = MonitorHandle(
            watched, self._announce_event, self._try_to_mark, self._trip if monitor_trips else None
        )

    # --- what it tells -------------------------------------------------------------------------

    @property
    def fault(self) -> str:
        """Reason of the latched fault; empty where there is none."""
        return self._latch.reason

    @property
    def rate_hz(self) -> float:
        """Ticks a second."""
        return self._settings.rig.loop.rate_hz

    @property
    def carrier(self) -> Carrier | None:
        """The loop; None while idle."""
        return self._carrier

    @property
    def state(self) -> RigState:
        """The present state."""
        from pamctl.signals import Phase

        carrier = self._carrier
        if self._latch.reason:
            return RigState.FAULT
        if carrier is None:
            return RigState.IDLE
        run = carrier.run
        if run is None:
            return RigState.READY
        phase = carrier.phase
        if phase == Phase.STOPPING:
            self._stopping = run
        if run.is_over or run is self._stopping:
            return RigState.STOPPING  # its last tick is a parked one, then its log is finished
        match phase:
            case None:  # just ordered
                return RigState.HOMING if carrier.runs_begun == 1 else RigState.RUNNING
            case Phase.HOMING:
                return RigState.HOMING
            case Phase.REST if self._holds:
                return RigState.READY
        return RigState.RUNNING

    def _mark(self, text: str) -> None:
        """Put a remark into the log of the current run."""
        with self._busy:  # the monitor marks from a thread of its own
            carrier = self._carrier
            if carrier is None or carrier.run is None:
                message = "nothing is being logged; start a run, or go to a position"
                raise RequestRefusedError(message)
            carrier.order({"do": "mark", "text": text})
            self._announce_event("mark", text=text)

    def _try_to_mark(self, text: str) -> None:
        with suppress(RequestRefusedError):  # nothing is being logged
            self._mark(text)

    def _announce_event(self, event: str, **details: object) -> None:
        message = {"event": event, "time_s": time.time(), **details}
        self.events.append(message)
        self._tell(message)

    # --- who may have an order now --------------------------------------------------------------

    @contextmanager
    def admit(self, order: Order) -> Iterator[None]:
        """Carry out one order after the other; refuse those that the state does not take."""
        with self._busy:
            takers = [state for state, row in STATES.items() if order.name in row.takes]
            if takers:
                self._require(*takers)
            yield

    def _require(self, *allowed: RigState) -> None:
        state = self.state
        if state in allowed and not self._is_leaving:
            return
        if state == RigState.FAULT:
            raise RequestRefusedError(
                f"fault: {self._latch.reason}; acknowledge it first with `pamctl ack`"
            )
        if RigState.FAULT in allowed:
            raise RequestRefusedError("there is no fault to acknowledge")
        if self._is_leaving:
            raise RequestRefusedError("the daemon is being ended")
        raise RequestRefusedError(f"not now: the state is {state}")

    def _trip(self, reason: str) -> None:
        carrier = self._carrier
        if carrier is not None:
            carrier.stop_now()
        else:
            self._maker.make_safe()
        self._latch.engage(reason)
        self._announce_event("estop")

    # --- the life of the loop --------------------------------------------------------------------

    def _begin(
        self,
        experiment: Mapping[str, Any],
        name: str,
        duration_s: float | None,
        said: Annotation | None = None,
    ) -> Path:
        from pamctl.control.experiment import HoldSettings
        from pamctl.daemon.requested_settings import (
            hand_over_course,
            load_experiment,
            require_feasible,
        )
        from pamctl.log.run_meta import NOTHING_SAID, annotate_meta, bare_name
        from pamctl.processes.run_once import make_run_meta

        settings = load_experiment(self._settings, experiment, name, duration_s)
        require_feasible(settings)
        rows = settings.rig.loop.ring_rows
        course, packed = hand_over_course(settings, rows)
        self._shelf.require_room(course.duration_s, self.rate_hz)
        carrier = self._carrier or self._begin_loop()
        # An emergency stop may have come meanwhile.
        self._require(RigState.READY, RigState.RUNNING)
        with self._shelf.new_path(f"{bare_name(self._names['controller'])}-{name}") as path:
            meta = make_run_meta(settings, {**self._names, "experiment": name}, path)
            meta = annotate_meta(meta, said or NOTHING_SAID)
            try:
                carrier.begin(name, meta, rows, packed)
            except RequestRefusedError:
                self._parked_since_s = time.monotonic()
                raise
        self._holds = isinstance(settings.experiment, HoldSettings)
        self.run_has_end = math.isfinite(course.duration_s)
        if carrier.run is not None:
            self._monitor.begin_run(name, carrier.run.ring.path)
        self._announce_event("run begins", run=name, log=str(path))
        return path

    def _begin_loop(self) -> Carrier:
        from pamctl.processes.interrupts import SleepInhibitor

        self._inhibitor = None if self._settings.fast else SleepInhibitor()
        try:
            carrier = self._maker.begin(self._settings, self._names)
        except BaseException:
            self._let_sleep()
            raise
        self._carrier, self._parked_since_s = carrier, time.monotonic()
        return carrier

    def look(self) -> None:
        """Check loop and run, and finish what has ended. Call it every few milliseconds."""
        carrier = self._carrier
        if carrier is not None:
            carrier.look()
        if not self._busy.acquire(blocking=False):
            return  # an order is being carried out; it looks after the loop itself
        try:
            self._check_loop(carrier)
        finally:
            self._busy.release()

    def makes_progress(self) -> bool:
        """Return whether the loop has ticked since the last call; True without a loop."""
        carrier = self._carrier
        tick = None if carrier is None else carrier.latest_tick()
        before, self._seen_tick = self._seen_tick, -1 if tick is None else int(tick["tick"])
        return tick is None or self._seen_tick != before

    def _check_loop(self, carrier: Carrier | None) -> None:
        if carrier is None or carrier is not self._carrier:
            return
        if not carrier.is_alive:
            ending = self._close_loop(carrier)
            if not self._is_leaving:  # it ended by itself
                self._note_fault(ending)
        elif carrier.run is not None and carrier.run.is_over:
            self._conclude_run(carrier, carrier.run)
        elif carrier.run is None and (self._latch.reason or self._is_parked_too_long):
            self._end_loop()

    @property
    def _is_parked_too_long(self) -> bool:
        return time.monotonic() - self._parked_since_s > self._idle_after_s

    def _conclude_run(self, carrier: Carrier, run: RecordedRun) -> None:
        self._stopping = run
        report = carrier.finish_run()
        self._holds = False
        self._parked_since_s = time.monotonic()
        note = report.note if report else ""
        self._announce_event("run over", run=run.name, log=str(run.log), note=note)
        if problem := self._shelf.put_away(run.log):
            self._announce_event("logs not in order", problem=problem)

    def leave(self) -> None:
        """Begin the smooth stop, and nothing more. Waits for no order; `close` must follow."""
        self._is_leaving = True
        carrier = self._carrier
        if carrier is not None:
            carrier.begin_end()

    def close(self) -> None:
        """End everything and begin nothing more; the valve is safe when this returns."""
        self.leave()
        with self._busy:
            self._end_loop()
        self._monitor.close()

    def stop_at_once(self) -> None:
        """End at once, at the safe voltage. This is no fault: nothing is left to acknowledge."""
        carrier = self._carrier
        if carrier is not None:
            carrier.stop_now()

    def _end_loop(self) -> None:
        carrier = self._carrier
        if carrier is None:
            return
        ending = self._close_loop(carrier)
        if ending.code in (ExitCode.OK, ExitCode.SIGTERM) or self._is_leaving:
            self._announce_event("idle")
        else:  # it was dead already, or did not come to its end
            self._note_fault(ending)

    def _note_fault(self, ending: Ending) -> None:
        self._latch.engage(ending.reason)
        self._announce_event("fault", reason=ending.reason, code=int(ending.code))

    def _close_loop(self, carrier: Carrier) -> Ending:
        ending = carrier.close()
        self._let_sleep()
        self._carrier, self._holds = None, False
        return ending

    def _let_sleep(self) -> None:
        if self._inhibitor is not None:
            self._inhibitor.release()
