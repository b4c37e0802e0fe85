"""What the daemon can be asked, and the plain life cycle behind it.

    idle -> homing -> running -> stopping -> ready -> running ... -> idle
    any of them -> fault, until acknowledged

Idle: nothing runs, the valve is safe. Ready: homed, and parked at the safe voltage or
holding a position. Every method either does what it says, or raises
`RequestRefusedError` and changes nothing. They are called from one thread at a time,
but for `estop` and `status`.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from pamctl import __version__
from pamctl.control.experiment import ExperimentSettings, HoldSettings, build_segments
from pamctl.daemon.latch import Latch
from pamctl.daemon.refusal import RequestRefusedError
from pamctl.daemon.session import DaemonRun, Session, Workshop
from pamctl.daemon.shelf import Shelf
from pamctl.exit_codes import Ending
from pamctl.log.naming import bare_name
from pamctl.realtime.gain_ramp import GainRampError, require_blendable
from pamctl.settings.problems import ConfigError
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    settings_to_data,
    validate_settings,
)
from pamctl.signals import TICK_FIELDS, Phase

_RECENT_EVENTS = 50
_MOST_VALUES = 5000
"""Of an answer: to write down more would keep the next client waiting."""
_LEISURELY_M_PER_S = 4e-3
_SHORTEST_MOTION_S = 0.5


class DaemonState(StrEnum):
    """Where in its life the daemon is."""

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
        idle_after_s: float = 600.0,
        tell: Callable[[Mapping[str, object]], object] = lambda event: None,
    ) -> None:
        """`settings` says rig, plant and the first gains; its experiment is not run.

        A session that is parked for `idle_after_s` ends. `tell` is called with every event, from
        any thread, and must not wait for anything. A fault that `latch` still knows, from
        before this daemon was started, has to be acknowledged first.
        """
        self._settings = settings
        self._names = dict(names)
        self._workshop = workshop
        self._shelf = shelf
        self._idle_after_s = idle_after_s
        self._session: Session | None = None
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

    # --- what is going on ------------------------------------------------------------------------

    @property
    def fault(self) -> str:
        """Why it is latched; empty where there is none."""
        return self._latch.reason

    @property
    def state(self) -> DaemonState:
        """The state of the moment."""
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
        """Say all that a client may want to know, in SI."""
        session = self._session
        run = None if session is None else session.run
        tick = None if session is None else session.latest_tick()
        return {
            "state": str(self.state),
            "fault": self._latch.reason,
            "run": None if run is None else run.name,
            "log": None if run is None else str(run.log),
            "tick": None if tick is None else _replace_nan(tick),
            "worst_late_s": None if session is None else session.worst_late_s,
            "missed_ticks": None if session is None else session.missed_ticks,
            "controller": settings_to_data(self._settings.controller),
            "names": self._names,
            "device": self._workshop.device,
            "backend": self._settings.rig.backend,
            "limits": {"stroke_mm": self._stroke_mm()},
            "disk_free_bytes": self._shelf.free_bytes,
            "pids": {} if session is None else session.pids,
            "uptime_s": time.monotonic() - self._began_s,
            "version": __version__,
            "events": list(self.events)[-10:],
        }

    def recent(self, after_tick: int, every: int, fields: Sequence[str] | None) -> dict[str, Any]:
        """Return the columns of every so-manieth tick since `after_tick`, oldest first.

        The newest of them, five thousand values at most: 1.3 s of all columns at 100 Hz. Numbers
        that are not finite are null.
        """
        session = self._session
        names = [field.name for field in TICK_FIELDS]
        unknown = set(fields or ()) - set(names)
        if unknown:
            raise RequestRefusedError(f"no column {', '.join(sorted(unknown))}")
        wanted = list(fields or names)
        most = _MOST_VALUES // len(wanted)
        ticks = [] if session is None else session.recent_ticks(after_tick, every, most)
        rows = [[_nan_to_none(tick[name]) for name in wanted] for tick in ticks]
        return {"fields": wanted, "ticks": rows}

    def _say(self, event: str, **details: object) -> None:
        told = {"event": event, "time_s": time.time(), **details}
        self.events.append(told)
        self._tell(told)

    # --- orders ----------------------------------------------------------------------------------

    def start(self, experiment: Mapping[str, Any], name: str, duration_s: float | None) -> Path:
        """Run an experiment, home first if need be; return its log's path."""
        with self._busy:
            self._require(DaemonState.IDLE, DaemonState.READY)
            return self._begin(experiment, bare_name(name), duration_s)

    def goto(self, position_m: float, within_s: float | None) -> Path:
        """Go to a position and hold it; home first if need be. Return the log's path."""
        with self._busy:
            self._require(DaemonState.IDLE, DaemonState.READY, DaemonState.RUNNING)
            self._require_within_stroke(position_m)
            motion_s = within_s or abs(position_m - self._here_m()) / _LEISURELY_M_PER_S
            hold = {
                "kind": "hold",
                "position_mm": position_m * 1e3,
                "transition_s": max(motion_s, _SHORTEST_MOTION_S),
            }
            session = self._session
            if session is None or session.run is None:
                return self._begin(hold, "goto", None)
            if not self._holds:
                raise RequestRefusedError(f"{session.run.name} is running; stop it first")
            # One log for all the positions that are held one after the other.
            session.order({"do": "run", "ring": None, "experiment": hold, "duration_s": None})
            return session.run.log

    def _require_within_stroke(self, position_m: float) -> None:
        low_mm, high_mm = self._stroke_mm()
        if not low_mm <= position_m * 1e3 <= high_mm:
            raise RequestRefusedError(
                f"goto {position_m * 1e3:g} mm lies outside the stroke of "
                f"{low_mm:g} to {high_mm:g} mm (rig.limits)"
            )

    def stop(self, reason: str = "stopped by request") -> None:
        """End what goes on, smoothly; the muscle stays homed and parked."""
        with self._busy:
            session = self._session
            if session is None or session.run is None:
                raise RequestRefusedError(f"nothing is running: the state is {self.state}")
            session.order({"do": "stop", "reason": reason})
            self._say("stopping", reason=reason)

    def disarm(self) -> None:
        """End the session: the next run homes anew. Smooth where something goes on."""
        with self._busy:
            self._end_session()

    def estop(self) -> None:
        """Drive the safe voltage within a tick, and latch the fault. Waits for nobody."""
        session = self._session
        if session is not None:
            session.stop_now()
        else:
            self._workshop.rig.make_safe()
        self._latch.engage("emergency stop")
        self._say("estop")

    def ack(self) -> str:
        """Acknowledge the fault; return what it was."""
        with self._busy:
            if not self._latch.reason:
                raise RequestRefusedError("there is no fault to acknowledge")
            if self._session is not None:
                raise RequestRefusedError("the loop is still ending; once more in a moment")
            fault = self._latch.release()
            self._say("acknowledged", fault=fault)
            return fault

    def set_gains(self, changes: Sequence[str], ramp_s: float) -> dict[str, Any]:
        """Change keys of the controller, `controller.lambda_per_s=12`; return all its keys."""
        with self._busy:
            raw = RawSettings({"controller": settings_to_data(self._settings.controller)})
            for change in changes:
                if not change.strip().startswith("controller."):
                    raise RequestRefusedError(
                        f"{change}: only keys of the controller change while it runs"
                    )
                try:
                    raw.override(change)
                except ConfigError as error:
                    raise _make_refusal(error) from error
            return self._tune(RawSettings(raw.data["controller"], _strip_section(raw)), ramp_s)

    def load_gains(self, controller: Mapping[str, Any], name: str, ramp_s: float) -> dict[str, Any]:
        """Take the gains of a whole controller file; return all its keys."""
        with self._busy:
            gains = self._tune(RawSettings(dict(controller), {(): name}), ramp_s)
            self._names["controller"] = name
            return gains

    def mark(self, text: str) -> None:
        """Put a remark into the log of the run that goes on."""
        with self._busy:
            if self._session is None or self._session.run is None:
                raise RequestRefusedError("nothing is being logged that could be marked")
            self._session.order({"do": "mark", "text": text})
            self._say("mark", text=text)

    # --- the life of sessions --------------------------------------------------------------------

    def look(self) -> None:
        """See how session and run are doing, and draw the consequences. Call it often."""
        session = self._session
        if session is not None:
            session.look()
        if not self._busy.acquire(blocking=False):
            return  # an order is being carried out, which looks itself
        try:
            self._look_after(session)
        finally:
            self._busy.release()

    def makes_progress(self) -> bool:
        """Tell whether the loop has ticked since this was asked last, where there is one."""
        session = self._session
        tick = None if session is None else session.latest_tick()
        before, self._seen_tick = self._seen_tick, -1 if tick is None else int(tick["tick"])
        return tick is None or self._seen_tick != before

    def _look_after(self, session: Session | None) -> None:
        if session is None or session is not self._session:
            return
        if not session.is_alive:
            self._conclude_session(self._close_session(session))
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
        self._say("run over", run=run.name, log=str(run.log), note=report.note if report else "")
        self._shelf.tidy()

    def close(self) -> None:
        """End everything, and begin nothing any more: the valve is safe when this returns."""
        self._is_leaving = True
        with self._busy:
            self._end_session()

    def hurry(self) -> None:
        """Let what is ending end at once, at the safe voltage. No fault: nothing is left to ack."""
        session = self._session
        if session is not None:
            session.stop_now()

    def _end_session(self) -> None:
        session = self._session
        if session is not None:
            self._close_session(session)
            self._say("idle")

    def _close_session(self, session: Session) -> Ending:
        ending = session.close()
        self._session, self._holds = None, False
        return ending

    def _conclude_session(self, ending: Ending) -> None:
        """A loop that ends by itself has had a reason."""
        self._latch.engage(ending.reason)
        self._say("fault", reason=ending.reason, code=int(ending.code))

    def _begin(self, experiment: Mapping[str, Any], name: str, duration_s: float | None) -> Path:
        settings = self._resolve_experiment(experiment, name, duration_s)
        length_s = sum(segment.duration_s for segment in build_segments(settings.experiment))
        self._shelf.require_room(min(length_s, duration_s or math.inf), self._rate_hz)
        session = self._session or self._begin_session()
        self._require(
            DaemonState.READY, DaemonState.RUNNING
        )  # an emergency stop may have come meanwhile
        path = self._shelf.new_path(f"{bare_name(self._names['controller'])}-{name}")
        meta = self._workshop.meta(settings, {**self._names, "experiment": name}, path)
        order = {
            "do": "run",
            "experiment": settings_to_data(settings.experiment),
            "duration_s": duration_s,
        }
        try:
            session.begin(name, meta, settings.rig.loop.ring_rows, order)
        except RequestRefusedError:
            self._parked_since_s = time.monotonic()
            raise
        self._holds = isinstance(settings.experiment, HoldSettings)
        self._say("run begins", run=name, log=str(path))
        return path

    def _begin_session(self) -> Session:
        session = Session(self._workshop, self._settings, self._names)
        self._session, self._parked_since_s = session, time.monotonic()
        return session

    # --- small questions -------------------------------------------------------------------------

    def _tune(self, raw: RawSettings, ramp_s: float) -> dict[str, Any]:
        try:
            controller = validate_settings(SECTIONS["controller"], raw, title="controller")
            settings = self._settings.model_copy(update={"controller": controller})
            RunSettings.model_validate(settings.model_dump())
        except ConfigError as error:
            raise _make_refusal(error) from error
        except ValueError as error:
            raise RequestRefusedError(str(error)) from error
        session = self._session
        if session is not None:
            if session.run is not None:
                self._require_tunable(controller)
            data = settings_to_data(controller)
            session.order({"do": "gains", "controller": data, "ramp_s": ramp_s})
        self._settings = settings
        self._say("gains", ramp_s=ramp_s)
        return settings_to_data(controller)

    def _require_tunable(self, controller: Any) -> None:
        try:
            require_blendable(self._settings.controller, controller)
        except GainRampError as error:
            raise RequestRefusedError(f"{error}; stop the run first") from error

    def _resolve_experiment(
        self, experiment: Mapping[str, Any], name: str, duration_s: float | None
    ) -> RunSettings:
        try:
            raw = RawSettings(dict(experiment), {(): name})
            checked: ExperimentSettings = validate_settings(
                SECTIONS["experiment"], raw, title="experiment"
            )
        except ConfigError as error:
            raise RequestRefusedError(str(error)) from error
        return self._settings.model_copy(update={"experiment": checked, "duration_s": duration_s})

    def _require(self, *allowed: DaemonState) -> None:
        state = self.state
        if state == DaemonState.FAULT:
            raise RequestRefusedError(
                f"fault: {self._latch.reason}; acknowledge it first (pamctl ack)"
            )
        if self._is_leaving:
            raise RequestRefusedError("the daemon is being ended")
        if state not in allowed:
            raise RequestRefusedError(f"not now: the state is {state}")

    def _here_m(self) -> float:
        tick = None if self._session is None else self._session.latest_tick()
        here_m = math.nan if tick is None else tick["position_m"]
        return 0.0 if math.isnan(here_m) else here_m

    def _stroke_mm(self) -> tuple[float, float]:
        limits = self._settings.rig.limits
        return limits.stroke_low_mm, limits.stroke_high_mm

    @property
    def _rate_hz(self) -> float:
        return self._settings.rig.loop.rate_hz


def _make_refusal(error: ConfigError) -> RequestRefusedError:
    """Name what was asked for as it was; the options of a start are not how it was asked."""
    return RequestRefusedError(
        str(error).replace("--set ", "").replace("with --controller", "by gains load")
    )


def _strip_section(raw: RawSettings) -> dict[Any, str]:
    return {at[1:]: origin for at, origin in raw.origins.items()}


def _replace_nan(tick: Mapping[str, float]) -> dict[str, float | None]:
    """JSON has no NaN: what is unknown is null."""
    return {name: _nan_to_none(value) for name, value in tick.items()}


def _nan_to_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
