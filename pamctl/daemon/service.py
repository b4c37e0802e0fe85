"""What clients can ask of the daemon, and the life cycle behind it.

    idle -> homing -> running -> stopping -> ready -> running ... -> idle
    any of them -> fault, until acknowledged

Idle: nothing runs, the valve is safe. Ready: homed, and parked at the safe voltage or
holding a position. Every method either does what it says, or raises
`RequestRefusedError` and changes nothing. One thread at a time calls them; `estop` and
`status` may be called from any thread.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Any

from pamctl import __version__
from pamctl.control.experiment import HoldSettings
from pamctl.daemon.gain_history import GainEdit, GainHistory
from pamctl.daemon.latch import Latch
from pamctl.daemon.monitor_desk import MonitorDesk
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.daemon.recent_columns import read_recent_columns, replace_nan
from pamctl.daemon.requested_settings import (
    change_gains,
    hand_over_course,
    load_controller,
    load_experiment,
    plan_hold,
    require_feasible,
    require_tunable,
)
from pamctl.daemon.session import DaemonRun, Session, Workshop
from pamctl.daemon.shelf import Shelf
from pamctl.exit_codes import EMERGENCY_STOP, Ending
from pamctl.log.annotation import NOTHING_SAID, Annotation, annotate_meta
from pamctl.log.run_meta import CHANGES, bare_name, describe_changes
from pamctl.plain_text import clean_text
from pamctl.plant.model import PlantSettings
from pamctl.processes.keep_awake import SleepInhibitor
from pamctl.runs.index_finished import index_in_own_process
from pamctl.settings.resolve import RunSettings, settings_to_data
from pamctl.signals import Phase

_RECENT_EVENTS = 50


class DaemonState(StrEnum):
    """States of the daemon's life cycle."""

    IDLE = "idle"
    HOMING = "homing"
    READY = "ready"
    RUNNING = "running"
    STOPPING = "stopping"
    FAULT = "fault"


class Service:
    """One rig, for as long as the daemon lives."""

    def __init__(
        self,
        settings: RunSettings,
        names: Mapping[str, str],
        workshop: Workshop,
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

        A session that is parked for `idle_after_s` ends. `tell` is called with every event, from
        any thread, and must not wait for anything. A fault that `latch` kept from before this
        daemon was started must be acknowledged first. A monitor follows every run against the
        plant `watched`; its alarm is an emergency stop where `monitor_trips`.
        """
        self._settings = settings
        self._names = dict(names)
        self._file_gains = file_gains or settings_to_data(settings.controller)
        self._workshop = workshop
        self._shelf = shelf
        self._idle_after_s = idle_after_s
        self._session: Session | None = None
        self._inhibitor: SleepInhibitor | None = None
        self._latch = latch
        self._holds = False
        self._stopping: DaemonRun | None = None
        self._parked_since_s = 0.0
        self._began_s = time.monotonic()
        self._busy = threading.RLock()
        self._seen_tick = -1
        self._is_leaving = False
        self._tell = tell
        self.events: deque[dict[str, Any]] = deque(maxlen=_RECENT_EVENTS)
        self._gain_history = GainHistory()
        self._monitor = MonitorDesk(
            watched, self._announce_event, self.mark, self._trip if monitor_trips else None
        )

    # --- status ------------------------------------------------------------------------

    @property
    def fault(self) -> str:
        """Reason of the latched fault; empty where there is none."""
        return self._latch.reason

    @property
    def state(self) -> DaemonState:
        """The present state."""
        session = self._session
        if self._latch.reason:
            return DaemonState.FAULT
        if session is None:
            return DaemonState.IDLE
        run = session.run
        if run is None:
            return DaemonState.READY
        phase = session.phase
        if phase == Phase.STOPPING:
            self._stopping = run
        if run.is_over or run is self._stopping:
            return DaemonState.STOPPING  # its last tick is a parked one, then its log is finished
        match phase:
            case None:  # just ordered
                return DaemonState.HOMING if session.runs_begun == 1 else DaemonState.RUNNING
            case Phase.HOMING:
                return DaemonState.HOMING
            case Phase.REST if self._holds:
                return DaemonState.READY
        return DaemonState.RUNNING

    def status(self) -> dict[str, Any]:
        """Return all that a client may want to know, in SI."""
        session = self._session
        run = None if session is None else session.run
        tick = None if session is None else session.latest_tick()
        return {
            "state": str(self.state),
            "fault": self._latch.reason,
            "run": None if run is None else run.name,
            "log": None if run is None else str(run.log),
            "ring": None if run is None else str(run.ring.path),
            "tick": None if tick is None else replace_nan(tick),
            "worst_late_s": None if session is None else session.worst_late_s,
            "missed_ticks": None if session is None else session.missed_ticks,
            "controller": settings_to_data(self._settings.controller),
            "names": self._names,
            "gain_changes": self._gain_history.tell(),
            "device": self._workshop.device,
            "backend": self._settings.rig.backend,
            "limits": {"stroke_mm": self._stroke_mm()},
            "logs": str(self._shelf.directory),
            "rate_hz": self._rate_hz,
            "disk_free_bytes": self._shelf.free_bytes,
            "pids": {**({} if session is None else session.pids), **self._monitor.pids},
            "monitor": self._monitor.status(),
            "uptime_s": time.monotonic() - self._began_s,
            "version": __version__,
            "events": list(self.events)[-10:],
        }

    def settings(self) -> dict[str, Any]:
        """Return everything that the daemon was set to, as the logs of its runs hold it."""
        return settings_to_data(self._settings)

    def recent(self, after_tick: int, every: int, fields: Sequence[str] | None) -> dict[str, Any]:
        """Return columns of the newest ticks, as `read_recent_columns` does."""
        return read_recent_columns(self._session, after_tick, every, fields)

    def _announce_event(self, event: str, **details: object) -> None:
        message = {"event": event, "time_s": time.time(), **details}
        self.events.append(message)
        self._tell(message)

    # --- orders ----------------------------------------------------------------------------------

    def start(
        self,
        experiment: Mapping[str, Any],
        name: str,
        duration_s: float | None,
        said: Annotation = NOTHING_SAID,
        records: Mapping[str, Mapping[str, str]] | None = None,
    ) -> Path:
        """Run an experiment; home first where needed. Return the path of its log.

        What is `said` of the run goes into its log, and so do further metadata `records` by name.
        """
        with self._busy:
            self._require(DaemonState.IDLE, DaemonState.READY)
            return self._begin(experiment, bare_name(name), duration_s, said, records)

    def goto(self, position_m: float, within_s: float | None) -> Path:
        """Go to a position and hold it; home first where needed. Return the path of the log."""
        with self._busy:
            self._require(DaemonState.IDLE, DaemonState.READY, DaemonState.RUNNING)
            hold = plan_hold(self._settings, position_m, within_s, self._current_position_m())
            session = self._session
            if session is None or session.run is None:
                return self._begin(hold, "goto", None)
            if not self._holds:
                raise RequestRefusedError(f"{session.run.name} is running; stop it first")
            # Positions that are held one after the other share one log.
            session.order({"do": "run", "ring": None, "experiment": hold, "duration_s": None})
            return session.run.log

    def stop(self, reason: str = "stopped by request") -> None:
        """End the current run, smoothly; the muscle stays homed and parked."""
        with self._busy:
            session = self._session
            if session is None or session.run is None:
                raise RequestRefusedError(f"nothing is running: the state is {self.state}")
            session.order({"do": "stop", "reason": reason})
            self._announce_event("stopping", reason=reason)

    def disarm(self) -> None:
        """End the session, smoothly; the next run homes again."""
        with self._busy:
            self._end_session()

    def estop(self) -> None:
        """Drive the safe voltage within a tick, and latch the fault. Waits for no order."""
        self._trip(EMERGENCY_STOP)

    def _trip(self, reason: str) -> None:
        session = self._session
        if session is not None:
            session.stop_now()
        else:
            self._workshop.rig.make_safe()
        self._latch.engage(reason)
        self._announce_event("estop")

    def ack(self) -> str:
        """Acknowledge the fault; return what it was."""
        with self._busy:
            if not self._latch.reason:
                raise RequestRefusedError("there is no fault to acknowledge")
            if self._session is not None:
                raise RequestRefusedError("the loop is still ending; try again in a moment")
            fault = self._latch.release()
            self._announce_event("acknowledged", fault=fault)
            return fault

    def set_gains(
        self, changes: Sequence[str], ramp_s: float, operator: str = ""
    ) -> dict[str, Any]:
        """Change keys of the controller, `controller.lambda_per_s=12`; return all its keys."""
        with self._busy:
            return self._tune(change_gains(self._settings, changes), ramp_s, operator)

    def undo_gains(self, ramp_s: float, operator: str = "") -> dict[str, Any]:
        """Take back the last change of single gains, whoever made it; return all keys."""
        with self._busy:
            last = self._gain_history.find_undoable()
            if last is None:
                raise RequestRefusedError("no change of the gains is left to undo")
            back = [f"controller.{name}={before!r}" for name, (before, _) in last.gains.items()]
            changed = change_gains(self._settings, back)
            return self._tune(changed, ramp_s, operator, undoes=last)

    def load_gains(self, controller: Mapping[str, Any], name: str, ramp_s: float) -> dict[str, Any]:
        """Take the gains of a whole controller file; return all its keys."""
        with self._busy:
            changed = load_controller(self._settings, controller, name)
            file_gains = settings_to_data(changed.controller)
            gains = self._tune(changed, ramp_s, file_gains=file_gains)
            self._names["controller"] = name
            self._gain_history.clear()
            return gains

    def mark(self, text: str) -> None:
        """Put a remark into the log of the current run."""
        with self._busy:
            if self._session is None or self._session.run is None:
                raise RequestRefusedError(
                    "nothing is being logged; start a run, or go to a position"
                )
            text = clean_text(text)
            if not text:
                raise RequestRefusedError("the remark is empty")
            self._session.order({"do": "mark", "text": text})
            self._announce_event("mark", text=text)

    # --- the life of sessions --------------------------------------------------------------------

    def look(self) -> None:
        """Check session and run, and finish what has ended. Call it every few milliseconds."""
        session = self._session
        if session is not None:
            session.look()
        if not self._busy.acquire(blocking=False):
            return  # an order is being carried out; it looks after the session itself
        try:
            self._check_session(session)
        finally:
            self._busy.release()

    def makes_progress(self) -> bool:
        """Return whether the loop has ticked since the last call; True without a loop."""
        session = self._session
        tick = None if session is None else session.latest_tick()
        before, self._seen_tick = self._seen_tick, -1 if tick is None else int(tick["tick"])
        return tick is None or self._seen_tick != before

    def _check_session(self, session: Session | None) -> None:
        if session is None or session is not self._session:
            return
        if not session.is_alive:
            ending = self._close_session(session)
            if not self._is_leaving:
                self._conclude_session(ending)
        elif session.run is not None and session.run.is_over:
            self._conclude_run(session)
        elif session.run is None and (self._latch.reason or self._parked_too_long):
            self._end_session()

    @property
    def _parked_too_long(self) -> bool:
        return time.monotonic() - self._parked_since_s > self._idle_after_s

    def _conclude_run(self, session: Session) -> None:
        run = session.run
        assert run is not None
        self._stopping = run
        report = session.finish_run()
        self._holds = False
        self._parked_since_s = time.monotonic()
        self._announce_event(
            "run over", run=run.name, log=str(run.log), note=report.note if report else ""
        )
        self._shelf.tidy()
        index_in_own_process(run.log)

    def leave(self) -> None:
        """Begin the smooth stop, and nothing more. Waits for no order; `close` must follow."""
        self._is_leaving = True
        session = self._session
        if session is not None:
            session.begin_end()

    def close(self) -> None:
        """End everything and begin nothing more; the valve is safe when this returns."""
        self.leave()
        with self._busy:
            self._end_session()
        self._monitor.close()

    def stop_at_once(self) -> None:
        """End at once, at the safe voltage. This is no fault: nothing is left to acknowledge."""
        session = self._session
        if session is not None:
            session.stop_now()

    def _end_session(self) -> None:
        session = self._session
        if session is not None:
            self._close_session(session)
            self._announce_event("idle")

    def _close_session(self, session: Session) -> Ending:
        ending = session.close()
        if self._inhibitor is not None:
            self._inhibitor.release()
        self._session, self._holds = None, False
        return ending

    def _conclude_session(self, ending: Ending) -> None:
        """Latch the reason of a loop that ended by itself."""
        self._latch.engage(ending.reason)
        self._announce_event("fault", reason=ending.reason, code=int(ending.code))

    def _begin(
        self,
        experiment: Mapping[str, Any],
        name: str,
        duration_s: float | None,
        said: Annotation = NOTHING_SAID,
        records: Mapping[str, Mapping[str, str]] | None = None,
    ) -> Path:
        settings = load_experiment(self._settings, experiment, name, duration_s)
        require_feasible(settings)
        rows = settings.rig.loop.ring_rows
        course, packed = hand_over_course(settings, rows)
        self._shelf.require_room(course.duration_s, self._rate_hz)
        session = self._session or self._begin_session()
        # An emergency stop may have come meanwhile.
        self._require(DaemonState.READY, DaemonState.RUNNING)
        path = self._shelf.new_path(f"{bare_name(self._names['controller'])}-{name}")
        meta = self._workshop.meta(settings, {**self._names, "experiment": name}, path)
        meta = annotate_meta(meta, said, records)
        try:
            session.begin(name, meta, rows, packed)
        except RequestRefusedError:
            self._parked_since_s = time.monotonic()
            raise
        self._holds = isinstance(settings.experiment, HoldSettings)
        if session.run is not None:
            self._monitor.begin_run(name, session.run.ring.path)
        self._announce_event("run begins", run=name, log=str(path))
        return path

    def _begin_session(self) -> Session:
        self._inhibitor = SleepInhibitor()
        try:
            session = Session(self._workshop, self._settings, self._names)
        except BaseException:
            self._inhibitor.release()
            raise
        self._session, self._parked_since_s = session, time.monotonic()
        return session

    # --- small questions -------------------------------------------------------------------------

    def _tune(
        self,
        changed: RunSettings,
        ramp_s: float,
        operator: str = "",
        *,
        file_gains: Mapping[str, Any] | None = None,
        undoes: GainEdit | None = None,
    ) -> dict[str, Any]:
        session = self._session
        before = settings_to_data(self._settings.controller)
        controller = settings_to_data(changed.controller)
        if session is not None:
            if session.run is not None:
                require_tunable(self._settings, changed)
            session.order({"do": "gains", "controller": controller, "ramp_s": ramp_s})
        self._settings = changed
        self._file_gains = file_gains or self._file_gains
        changes = describe_changes(controller, self._file_gains)
        self._names.pop(CHANGES, None)
        if changes:
            self._names[CHANGES] = changes
        change = self._gain_history.note(before, controller, operator, undoes)
        self._announce_event("gains", ramp_s=ramp_s, changes=changes, by=operator)
        if operator and change is not None and session is not None and session.run is not None:
            with suppress(RequestRefusedError):  # the gains hold, whatever became of the run
                session.order({"do": "mark", "text": f"{operator}: {change.describe()}"})
        return controller

    def _require(self, *allowed: DaemonState) -> None:
        state = self.state
        if state == DaemonState.FAULT:
            raise RequestRefusedError(
                f"fault: {self._latch.reason}; acknowledge it first with `pamctl ack`"
            )
        if self._is_leaving:
            raise RequestRefusedError("the daemon is being ended")
        if state not in allowed:
            raise RequestRefusedError(f"not now: the state is {state}")

    def _current_position_m(self) -> float:
        tick = None if self._session is None else self._session.latest_tick()
        here_m = math.nan if tick is None else tick["position_m"]
        return 0.0 if math.isnan(here_m) else here_m

    def _stroke_mm(self) -> tuple[float, float]:
        limits = self._settings.rig.limits
        return limits.stroke_low_mm, limits.stroke_high_mm

    @property
    def _rate_hz(self) -> float:
        return self._settings.rig.loop.rate_hz
