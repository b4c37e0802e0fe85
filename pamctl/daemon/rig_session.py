"""What can be asked of a rig: its orders, each described once.

Each method marked with `@order` is an order everywhere: on the socket, for the Python session, for
the page and as a verb. Either it does what it says, or it raises `RequestRefusedError` and changes
nothing. Orders that change something are carried out one after the other; the others may come
from any thread. States, and which of them takes which order, are in `session_life.py`.

Verbs read the signatures here: what only a living session needs is imported where it is used.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, Field

from pamctl import __version__
from pamctl.base.errors import EMERGENCY_STOP
from pamctl.base.texts import (
    LONGEST_NAME,
    LONGEST_NOTE,
    LONGEST_REMARK,
    MOST_TAGS,
    clean_text,
    replace_nan,
)
from pamctl.daemon.protocol import RequestRefusedError, order
from pamctl.daemon.session_life import SessionLife

if TYPE_CHECKING:
    from pamctl.daemon.requested_settings import GainEdit
    from pamctl.settings.resolve import RunSettings

_MOST_VALUES = 5000
"""Values in one answer: writing more would keep the next client waiting."""


# --- what orders are made of -------------------------------------------------------------------


DEFAULT_RAMP_S = 0.5

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


class RigSession(SessionLife):
    """One rig, for as long as its daemon or its simulation lives."""

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
            "tick": replace_nan(tick),
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
            "ticks": replace_nan([[tick[name] for name in chosen] for tick in ticks]),
        }

    # --- orders ----------------------------------------------------------------------------------

    @order(on_page=True, said="log: {log}")
    def start(
        self,
        experiment: dict[str, Any],
        name: Name,
        duration_s: Annotated[float | None, Field(gt=0)] = None,
        note: Annotated[str, Field(max_length=LONGEST_NOTE)] = "",
        operator: Annotated[str, Field(max_length=LONGEST_NAME)] = "",
        sample: Annotated[str, Field(max_length=LONGEST_NAME)] = "",
        tags: Annotated[list[str], Field(max_length=MOST_TAGS)] = [],  # noqa: B006
    ) -> dict[str, str]:
        """Run an experiment; home first if the muscle is not homed."""
        from pamctl.log.run_meta import AnnotationError, bare_name, make_annotation

        try:
            said = make_annotation(tags, note, operator, sample)
        except AnnotationError as error:
            raise RequestRefusedError(str(error)) from error
        return {"log": str(self._begin(experiment, bare_name(name), duration_s, said))}

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
        self,
        reason: Annotated[
            str, AfterValidator(clean_text), Field(max_length=LONGEST_NAME)
        ] = "stopped by request",
    ) -> None:
        """Stop what is running, smoothly; the muscle stays homed."""
        carrier = self._carrier
        if carrier is None or carrier.run is None:
            raise RequestRefusedError(f"nothing is running: the state is {self.state}")
        carrier.order({"do": "stop", "reason": reason})
        self._announce_event("stopping", reason=reason)

    @order(on_page=True, said="idle")
    def disarm(self) -> None:
        """End the session; the next run homes again."""
        before = self.fault
        self._end_loop()
        if self.fault and not before:
            raise RequestRefusedError(f"the session did not end well: {self.fault}")

    @order(changes=False, at_once=True, on_page=True, said="emergency stop")
    def estop(self) -> None:
        """Drive the safe voltage within a tick; latched until `pamctl ack`."""
        self._trip(EMERGENCY_STOP)

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
        self._mark(clean_text(text))

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
