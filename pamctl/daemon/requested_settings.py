"""Gains and experiments that clients ask for, checked; and who changed which gain when.

Each function raises `RequestRefusedError`, with the place and the reason, for what cannot be used.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pamctl.base.errors import ConfigError
from pamctl.base.texts import to_json
from pamctl.control.course import Course, pack_handed_course
from pamctl.control.experiment import ExperimentSettings, plan_experiment
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.realtime.gain_ramp import GainRampError, require_blendable
from pamctl.recording.rows import PAYLOAD_BYTES
from pamctl.settings.envelope import find_excesses
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    settings_to_data,
    validate_settings,
)

_LEISURELY_M_PER_S = 4e-3
_SHORTEST_MOTION_S = 0.5


def change_gains(settings: RunSettings, changes: Sequence[str]) -> RunSettings:
    """Return the settings with keys of the controller changed: `controller.lambda_per_s=12`."""
    raw = RawSettings({"controller": settings_to_data(settings.controller)})
    for change in changes:
        if not change.strip().startswith("controller."):
            key = change.partition("=")[0].strip()
            meant = (
                f"; did you mean 'controller.{key}'?"
                if key in raw.data["controller"]
                else "; write controller.KEY=VALUE; `pamctl gains show` lists the keys"
            )
            message = f"{change}: only keys of the controller change while it runs{meant}"
            raise RequestRefusedError(message)
        try:
            raw.override(change)
        except ConfigError as error:
            raise _make_refusal(error) from error
    origins = {at[1:]: origin for at, origin in raw.origins.items()}
    return _use_controller(settings, RawSettings(raw.data["controller"], origins))


def load_controller(settings: RunSettings, controller: Mapping[str, Any], name: str) -> RunSettings:
    """Return the settings with the controller of a whole file."""
    return _use_controller(settings, RawSettings(dict(controller), {(): name}))


def load_experiment(
    settings: RunSettings, experiment: Mapping[str, Any], name: str, duration_s: float | None
) -> RunSettings:
    """Return the settings with the experiment of a whole file."""
    try:
        raw = RawSettings(dict(experiment), {(): name})
        checked: ExperimentSettings = validate_settings(
            SECTIONS["experiment"], raw, title="experiment"
        )
    except ConfigError as error:
        raise RequestRefusedError(str(error)) from error
    return settings.model_copy(update={"experiment": checked, "duration_s": duration_s})


def plan_hold(
    settings: RunSettings, position_m: float, within_s: float | None, here_m: float
) -> dict[str, Any]:
    """Return the experiment that goes to a position and holds it; refuse one beyond the stroke.

    The motion takes `within_s`, or as long as 4 mm/s take from `here_m`.
    """
    limits = settings.rig.limits
    if not limits.stroke_low_mm <= position_m * 1e3 <= limits.stroke_high_mm:
        raise RequestRefusedError(
            f"goto {position_m * 1e3:g} mm lies outside the stroke of {limits.stroke_low_mm:g} to "
            f"{limits.stroke_high_mm:g} mm (rig.limits)"
        )
    motion_s = within_s or abs(position_m - here_m) / _LEISURELY_M_PER_S
    return {
        "kind": "hold",
        "position_mm": position_m * 1e3,
        "transition_s": max(motion_s, _SHORTEST_MOTION_S),
    }


def require_feasible(settings: RunSettings) -> None:
    """Refuse an experiment that asks for more than rig and model can do."""
    excesses = find_excesses(settings)
    if excesses:
        raise RequestRefusedError("; ".join(f"the experiment {e}" for e in excesses))


def hand_over_course(settings: RunSettings, ring_rows: int) -> tuple[Course, bytes]:
    """Return the course of an experiment, and the same packed for the loop.

    The text with it is what the loop records. Refuse one that has no room in the ring.
    """
    plan = plan_experiment(settings.experiment)
    course = Course(plan.segments, settings.duration_s, plan.cues)
    told = {
        "experiment": settings_to_data(settings.experiment),
        "duration_s": settings.duration_s,
    }
    text = to_json(told)[1:-1]
    most = ring_rows // 4 * PAYLOAD_BYTES
    if len(text) > most:
        raise RequestRefusedError(
            f"the experiment has {len(text)} bytes, and a quarter of the ring only {most}; "
            "make rig.loop.ring_rows larger"
        )
    return course, pack_handed_course(course, text)


def require_tunable(settings: RunSettings, changed: RunSettings) -> None:
    """Refuse gains between which the loop cannot blend while it runs."""
    try:
        require_blendable(settings.controller, changed.controller)
    except GainRampError as error:
        raise RequestRefusedError(f"{error}; stop the run first") from error


def _use_controller(settings: RunSettings, raw: RawSettings) -> RunSettings:
    try:
        controller = validate_settings(SECTIONS["controller"], raw, title="controller")
        changed = settings.model_copy(update={"controller": controller})
        RunSettings.model_validate(changed.model_dump())
    except ConfigError as error:
        raise _make_refusal(error) from error
    except ValueError as error:
        raise RequestRefusedError(str(error)) from error
    if controller.compensate != settings.controller.compensate:
        raise RequestRefusedError("another `compensate` takes effect when the daemon starts again")
    return changed


def _make_refusal(error: ConfigError) -> RequestRefusedError:
    """Name the requested value: a client does not give the options of a start."""
    return RequestRefusedError(
        str(error).replace("--set ", "").replace("with --controller", "by gains load")
    )


_KEPT_CHANGES = 20


@dataclass(frozen=True)
class GainEdit:
    """Gains that were changed together."""

    time_s: float
    """Wall clock."""
    by: str
    """The name that the client gave; empty if it gave none."""
    gains: Mapping[str, tuple[Any, Any]]
    """Values before and after, by name."""
    is_undo: bool = False
    is_undone: bool = False

    def describe(self) -> str:
        """Return `lambda_per_s 37.82 to 60`, for the log and for people."""
        said = ", ".join(
            f"{name} {_spell(before)} to {_spell(after)}"
            for name, (before, after) in self.gains.items()
        )
        return f"{said} (undo)" if self.is_undo else said


class GainHistory:
    """The newest changes of gains, oldest first."""

    def __init__(self) -> None:
        """Begin without a change."""
        self._changes: deque[GainEdit] = deque(maxlen=_KEPT_CHANGES)

    def note(
        self,
        before: Mapping[str, Any],
        after: Mapping[str, Any],
        by: str,
        undoes: GainEdit | None = None,
    ) -> GainEdit | None:
        """Remember a change, which may take back an earlier one. None if nothing has changed."""
        gains = {
            name: (before.get(name), value)
            for name, value in after.items()
            if before.get(name) != value
        }
        if undoes is not None:
            kept = [replace(c, is_undone=True) if c is undoes else c for c in self._changes]
            self._changes = deque(kept, _KEPT_CHANGES)
        if not gains:
            return None
        change = GainEdit(time.time(), by, gains, is_undo=undoes is not None)
        self._changes.append(change)
        return change

    def find_undoable(self) -> GainEdit | None:
        """Return the newest change that was not taken back, and takes nothing back itself."""
        left = (c for c in reversed(self._changes) if not c.is_undo and not c.is_undone)
        return next(left, None)

    def clear(self) -> None:
        """Forget all: other gains were loaded, perhaps of another law."""
        self._changes.clear()

    def tell(self) -> list[dict[str, Any]]:
        """Return the changes for a status."""
        undoable = self.find_undoable()
        return [
            {"time_s": c.time_s, "by": c.by, "what": c.describe(), "undoable": c is undoable}
            for c in self._changes
        ]


def _spell(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
