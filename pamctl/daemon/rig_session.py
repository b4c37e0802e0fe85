"""One rig and what can be asked of it: its states, its orders, and the life of its loop.

Each method marked with `@order` is an order everywhere: on the socket, for the Python session, for
the page and as a verb. Either it does what it says, or it raises `RequestRefusedError` and changes
nothing. Orders that change something are carried out one after the other; the others may come
from any thread. The loop runs in a carrier: processes of its own (`daemon/session.py`), or this
process, for a simulation without a clock (`session/in_process.py`).

Verbs read the signatures here: what only a living session needs is imported where it is used.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field

from pamctl import __version__
from pamctl.daemon.protocol import Order, OrderTaker, RequestRefusedError, order
from pamctl.exit_codes import EMERGENCY_STOP, Ending
from pamctl.plain_text import LONGEST_REMARK, clean_text

if TYPE_CHECKING:
    from pamctl.daemon.carrier import CarriedRun, Carrier, CarrierMaker
    from pamctl.daemon.requested_settings import GainEdit
    from pamctl.daemon.shelf import Latch, Shelf
    from pamctl.log.annotation import Annotation
    from pamctl.plant.model import PlantSettings
    from pamctl.processes.keep_awake import SleepInhibitor
    from pamctl.settings.resolve import RunSettings

_RECENT_EVENTS = 50
_MOST_SWEPT = 8
_MOST_VALUES = 5000
"""Values in one answer: writing more would keep the next client waiting."""


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

# --- what orders are made of -------------------------------------------------------------------


def _refuse_many(swept: Any) -> Any:
    """Count first: to check thousands of entries would keep an emergency stop waiting."""
    if isinstance(swept, dict) and len(swept) > _MOST_SWEPT:
        raise ValueError(f"more than {_MOST_SWEPT} entries")
    return swept


DEFAULT_RAMP_S = 0.5
LONGEST_NOTE, LONGEST_NAME, MOST_TAGS = 2000, 200, 64

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]
Ramp = Annotated[float, Field(ge=0, le=60, description="Time over which the gains change")]
Operator = Annotated[str, AfterValidator(clean_text), Field(max_length=LONGEST_NAME)]
Remark = Annotated[
    str,
    AfterValidator(clean_text),
    Field(min_length=1, max_length=LONGEST_REMARK, description="Remark of 1 to 2000 characters"),
]
Length = Annotated[
    float, Field(title="POSITION", description="Position such as 12mm, 0.012m or 12 (mm)")
]
Within = Annotated[
    float | None,
    Field(
        gt=0,
        le=3600,
        description="Duration of the motion",
        json_schema_extra={"option": "--in", "default": "as long as 4 mm/s takes"},
    ),
]
Changes = Annotated[
    list[str],
    Field(
        min_length=1,
        max_length=32,
        title="KEY=VALUE...",
        description="Gains to change, such as controller.lambda_per_s=12",
    ),
]


class RigSession(OrderTaker):
    """One rig, for as long as its daemon or its simulation lives."""

    def __init__(
        self,
        settings: RunSettings,
        names: Mapping[str, str],
        maker: CarrierMaker,
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
        from pamctl.daemon.announcements import MonitorDesk
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
        self._stopping: CarriedRun | None = None
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

    @order(changes=False)
    def status(self) -> dict[str, Any]:
        """Show what the daemon is doing."""
        from pamctl.settings.resolve import settings_to_data

        carrier, rig = self._carrier, self._settings.rig
        run = None if carrier is None else carrier.run
        tick = None if carrier is None else carrier.latest_tick()
        return {
            "state": str(self.state),
            "fault": self._latch.reason,
            "run": None if run is None else run.name,
            "log": None if run is None else str(run.log),
            "ring": None if run is None else str(run.ring.path),
            "tick": None
            if tick is None
            else {name: _finite(value) for name, value in tick.items()},
            "worst_late_s": None if carrier is None else carrier.worst_late_s,
            "missed_ticks": None if carrier is None else carrier.missed_ticks,
            "controller": settings_to_data(self._settings.controller),
            "names": dict(self._names),
            "gain_changes": self._gain_history.tell(),
            "device": self._maker.device,
            "backend": rig.backend,
            "limits": {"stroke_mm": (rig.limits.stroke_low_mm, rig.limits.stroke_high_mm)},
            "logs": str(self._shelf.directory),
            "rate_hz": self.rate_hz,
            "disk_free_bytes": self._shelf.free_bytes,
            "pids": {**({} if carrier is None else carrier.pids), **self._monitor.pids},
            "monitor": self._monitor.status(),
            "uptime_s": time.monotonic() - self._began_s,
            "version": __version__,
            "events": list(self.events)[-10:],
        }

    @order(changes=False)
    def settings(self) -> dict[str, Any]:
        """Show everything that the daemon was set to, as the logs of its runs hold it."""
        from pamctl.settings.resolve import settings_to_data

        return settings_to_data(self._settings)

    @order(changes=False)
    def recent(
        self,
        after_tick: int = -1,
        every: Annotated[int, Field(ge=1, le=100_000)] = 10,
        fields: Annotated[list[str] | None, Field(max_length=100)] = None,
    ) -> dict[str, Any]:
        """Show columns of the ticks after `after_tick` whose number `every` divides.

        Oldest first; the newest five thousand values at most, which is 1.3 s of all columns at
        100 Hz. Numbers that are not finite are null.
        """
        from pamctl.signals import TICK_FIELDS

        names = [field.name for field in TICK_FIELDS]
        unknown = set(fields or ()) - set(names)
        if unknown:
            raise RequestRefusedError(f"no column {', '.join(sorted(unknown))}")
        chosen = list(fields or names)
        carrier, most = self._carrier, _MOST_VALUES // len(chosen)
        ticks = [] if carrier is None else carrier.recent_ticks(after_tick, every, most)
        return {
            "fields": chosen,
            "ticks": [[_finite(tick[name]) for name in chosen] for tick in ticks],
        }

    def _announce_event(self, event: str, **details: object) -> None:
        message = {"event": event, "time_s": time.time(), **details}
        self.events.append(message)
        self._tell(message)

    # --- orders ----------------------------------------------------------------------------------

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

    @order(on_page=True, said="log: {log}")
    def start(
        self,
        experiment: dict[str, Any],
        name: Name,
        duration_s: Annotated[float | None, Field(gt=0)] = None,
        note: Annotated[str, Field(max_length=LONGEST_NOTE)] = "",
        operator: Annotated[str, Field(max_length=LONGEST_NAME)] = "",
        sample: Annotated[str, Field(max_length=LONGEST_NAME)] = "",
        tags: Annotated[Sequence[str], Field(max_length=MOST_TAGS)] = (),
        sweep: Annotated[dict[str, str] | None, BeforeValidator(_refuse_many)] = None,
    ) -> dict[str, str]:
        """Run an experiment; home first if the muscle is not homed."""
        from pamctl.log.annotation import SWEEP, AnnotationError, make_annotation
        from pamctl.log.run_meta import bare_name

        try:
            said = make_annotation(tags, note, operator, sample)
        except AnnotationError as error:
            raise RequestRefusedError(str(error)) from error
        records = {} if sweep is None else {SWEEP: sweep}
        return {"log": str(self._begin(experiment, bare_name(name), duration_s, said, records))}

    @order(on_page=True, said="log: {log}")
    def goto(self, position_m: Length, within_s: Within = None) -> dict[str, str]:
        """Go to a position and hold it."""
        from pamctl.daemon.requested_settings import plan_hold

        carrier = self._carrier
        tick = None if carrier is None else carrier.latest_tick()
        here_m = math.nan if tick is None else tick["position_m"]
        hold = plan_hold(
            self._settings, position_m, within_s, 0.0 if math.isnan(here_m) else here_m
        )
        if carrier is None or carrier.run is None:
            return {"log": str(self._begin(hold, "goto", None))}
        if not self._holds:
            raise RequestRefusedError(f"{carrier.run.name} is running; stop it first")
        # Positions that are held one after the other share one log.
        carrier.order({"do": "run", "ring": None, "experiment": hold, "duration_s": None})
        return {"log": str(carrier.run.log)}

    @order(on_page=True, said="stopping")
    def stop(
        self, reason: Annotated[str, Field(max_length=LONGEST_NAME)] = "stopped by request"
    ) -> None:
        """Stop what is running, smoothly; the muscle stays homed."""
        carrier = self._carrier
        if carrier is None or carrier.run is None:
            raise RequestRefusedError(f"nothing is running: the state is {self.state}")
        carrier.order({"do": "stop", "reason": clean_text(reason)})
        self._announce_event("stopping", reason=reason)

    @order(on_page=True, said="idle")
    def disarm(self) -> None:
        """End the session; the next run homes again."""
        self._end_loop()

    @order(changes=False, at_once=True, on_page=True, said="emergency stop")
    def estop(self) -> None:
        """Drive the safe voltage within a tick; latched until `pamctl ack`."""
        self._trip(EMERGENCY_STOP)

    def _trip(self, reason: str) -> None:
        carrier = self._carrier
        if carrier is not None:
            carrier.stop_now()
        else:
            self._maker.make_safe()
        self._latch.engage(reason)
        self._announce_event("estop")

    @order(on_page=True, said="acknowledged: {fault}")
    def ack(self) -> dict[str, str]:
        """Acknowledge a fault, so that the daemon runs again."""
        if self._carrier is not None:
            raise RequestRefusedError("the loop is still ending; try again in a moment")
        fault = self._latch.release()
        self._announce_event("acknowledged", fault=fault)
        return {"fault": fault}

    @order(on_page=True)
    def set(
        self, changes: Changes, ramp_s: Ramp = DEFAULT_RAMP_S, operator: Operator = ""
    ) -> dict[str, Any]:
        """Change gains while the loop runs, on a ramp."""
        from pamctl.daemon.requested_settings import change_gains

        return self._tune(change_gains(self._settings, changes), ramp_s, operator)

    @order(on_page=True)
    def undo(self, ramp_s: Ramp = DEFAULT_RAMP_S, operator: Operator = "") -> dict[str, Any]:
        """Take back the last change of single gains, whoever made it."""
        from pamctl.daemon.requested_settings import change_gains

        last = self._gain_history.find_undoable()
        if last is None:
            raise RequestRefusedError("no change of the gains is left to undo")
        back = [f"controller.{name}={before!r}" for name, (before, _) in last.gains.items()]
        return self._tune(change_gains(self._settings, back), ramp_s, operator, undoes=last)

    @order()
    def load(
        self, controller: dict[str, Any], name: Name, ramp_s: Ramp = DEFAULT_RAMP_S
    ) -> dict[str, Any]:
        """Take the gains of a controller file, on a ramp; another law only between runs."""
        from pamctl.daemon.requested_settings import load_controller
        from pamctl.settings.resolve import settings_to_data

        changed = load_controller(self._settings, controller, name)
        file_gains = settings_to_data(changed.controller)
        gains = self._tune(changed, ramp_s, file_gains=file_gains)
        self._names["controller"] = name
        self._gain_history.clear()
        return gains

    @order(on_page=True, said="marked")
    def mark(self, text: Remark) -> None:
        """Put a remark into the log of the current run."""
        carrier = self._carrier
        if carrier is None or carrier.run is None:
            raise RequestRefusedError("nothing is being logged; start a run, or go to a position")
        text = clean_text(text)
        carrier.order({"do": "mark", "text": text})
        self._announce_event("mark", text=text)

    def _tune(
        self,
        changed: RunSettings,
        ramp_s: float,
        operator: str = "",
        *,
        file_gains: Mapping[str, Any] | None = None,
        undoes: GainEdit | None = None,
    ) -> dict[str, Any]:
        from pamctl.daemon.requested_settings import require_tunable
        from pamctl.log.run_meta import CHANGES, describe_changes
        from pamctl.settings.resolve import settings_to_data

        carrier = self._carrier
        before = settings_to_data(self._settings.controller)
        controller = settings_to_data(changed.controller)
        if carrier is not None:
            if carrier.run is not None:
                require_tunable(self._settings, changed)
            carrier.order({"do": "gains", "controller": controller, "ramp_s": ramp_s})
        self._settings = changed
        self._file_gains = file_gains or self._file_gains
        changes = describe_changes(controller, self._file_gains)
        self._names.pop(CHANGES, None)
        if changes:
            self._names[CHANGES] = changes
        change = self._gain_history.note(before, controller, operator, undoes)
        self._announce_event("gains", ramp_s=ramp_s, changes=changes, by=operator)
        if operator and change is not None and carrier is not None and carrier.run is not None:
            with suppress(RequestRefusedError):  # the gains hold, whatever became of the run
                carrier.order({"do": "mark", "text": f"{operator}: {change.describe()}"})
        return controller

    # --- the life of the loop --------------------------------------------------------------------

    def _begin(
        self,
        experiment: Mapping[str, Any],
        name: str,
        duration_s: float | None,
        said: Annotation | None = None,
        records: Mapping[str, Mapping[str, str]] | None = None,
    ) -> Path:
        from pamctl.control.experiment import HoldSettings
        from pamctl.daemon.requested_settings import (
            hand_over_course,
            load_experiment,
            require_feasible,
        )
        from pamctl.log.annotation import NOTHING_SAID, annotate_meta
        from pamctl.log.run_meta import bare_name

        settings = load_experiment(self._settings, experiment, name, duration_s)
        require_feasible(settings)
        rows = settings.rig.loop.ring_rows
        course, packed = hand_over_course(settings, rows)
        self._shelf.require_room(course.duration_s, self.rate_hz)
        carrier = self._carrier or self._begin_loop()
        # An emergency stop may have come meanwhile.
        self._require(RigState.READY, RigState.RUNNING)
        with self._shelf.new_path(f"{bare_name(self._names['controller'])}-{name}") as path:
            meta = self._maker.meta(settings, {**self._names, "experiment": name}, path)
            meta = annotate_meta(meta, said or NOTHING_SAID, records)
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
        from pamctl.processes.keep_awake import SleepInhibitor

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
                self._latch.engage(ending.reason)
                self._announce_event("fault", reason=ending.reason, code=int(ending.code))
        elif carrier.run is not None and carrier.run.is_over:
            self._conclude_run(carrier, carrier.run)
        elif carrier.run is None and (self._latch.reason or self._is_parked_too_long):
            self._end_loop()

    @property
    def _is_parked_too_long(self) -> bool:
        return time.monotonic() - self._parked_since_s > self._idle_after_s

    def _conclude_run(self, carrier: Carrier, run: CarriedRun) -> None:
        self._stopping = run
        report = carrier.finish_run()
        self._holds = False
        self._parked_since_s = time.monotonic()
        note = report.note if report else ""
        self._announce_event("run over", run=run.name, log=str(run.log), note=note)
        self._shelf.put_away(run.log)

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
        if carrier is not None:
            self._close_loop(carrier)
            self._announce_event("idle")

    def _close_loop(self, carrier: Carrier) -> Ending:
        ending = carrier.close()
        self._let_sleep()
        self._carrier, self._holds = None, False
        return ending

    def _let_sleep(self) -> None:
        if self._inhibitor is not None:
            self._inhibitor.release()


def _finite(value: float) -> float | None:
    """Return a number for JSON, which has no NaN: an unknown value is null."""
    return value if math.isfinite(value) else None
