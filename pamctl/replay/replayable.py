"""What a replay needs, taken from a log; or the reason why there is nothing to replay in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hal.backend import find_backends
from hal.calibration import Zero
from pamctl.control.law import ControllerSettings
from pamctl.json_text import to_json
from pamctl.log import Log
from pamctl.realtime.keyframe import keyframe_fields, thaw_state
from pamctl.realtime.tick import TickState, first_state
from pamctl.replay.recorded_run import GainChange, NotReplayable, ReplaySource
from pamctl.replay.retick import RETICK_FIELDS, TickInputs
from pamctl.settings.problems import ConfigError
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    from_resolved,
    validate_settings,
)


def read_replay_source(log: Log) -> ReplaySource:
    """Take from a log what a replay needs; raise NotReplayable."""
    _refuse_imported(log)
    if not len(log):
        raise NotReplayable(f"{log.path} holds no tick")
    _require_columns(log)
    ticks = log["tick"]
    if np.any(np.diff(ticks) <= 0):
        raise NotReplayable(
            f"the ticks of {log.path} are not in order; see `pamctl log check {log.path}`"
        )
    settings = _read_settings(log)
    keyframes, orders = _read_keyframes(log), _read_orders(log)
    return ReplaySource(
        log=log,
        settings=settings,
        zeros=_read_zeros(log),
        # A single run begins with what is configured; one that was ordered, with what was set.
        gains=_read_controller(log, log.gains[0]) if orders else settings.controller,
        changes=_read_gain_changes(log),
        orders=orders,
        stops=frozenset(_index_by_tick(log, (e for e in log.events if e["event"] == "stopping"))),
        keyframes=keyframes,
        losses=_find_losses(log, begins_known=-1 in keyframes),
    )


def _refuse_imported(log: Log) -> None:
    if log.is_imported:
        raise NotReplayable(
            f"{log.path} is an imported measurement: no tick of pamctl made it, and there is "
            "nothing to replay in it; `pamctl compare` and `pamctl diagnose` work on it"
        )


def _require_columns(log: Log) -> None:
    needed = (*TickInputs._fields, "valve_v", "applied_v")
    missing = [name for name in needed if name not in log.columns]
    if missing:
        raise NotReplayable(
            f"{log.path} lacks {', '.join(missing)}, which this version's tick needs; "
            f"{_suggest_version(log)}"
        )


def _suggest_version(log: Log) -> str:
    version = log.metadata.get("pamctl", {}).get("version", "that wrote it")
    return f"replay it with pamctl {version}"


def _read_settings(log: Log) -> RunSettings:
    if not log.config:
        raise NotReplayable(f"{log.path} carries no configuration (config.json): nothing to replay")
    try:
        return from_resolved(to_json(log.config).decode(), f"{log.path}:config.json")
    except ConfigError as error:
        _require_backend_of(log)
        raise NotReplayable(
            f"the configuration in {log.path} does not fit this version; "
            f"{_suggest_version(log)}. What does not fit:\n{error}"
        ) from error


def _require_backend_of(log: Log) -> None:
    """Raise `NotReplayable` where the log's backend belongs to a package that is missing."""
    run = log.metadata.get("run", {})
    backend, package = run.get("backend", ""), run.get("backend_package")
    if package and backend not in find_backends().found:
        raise NotReplayable(
            f"{log.path} was made with the backend '{backend}' of the package {package}, "
            "which is not installed here: install it"
        )


def _read_zeros(log: Log) -> dict[int, Zero]:
    events = _index_by_tick(log, (event for event in log.events if event["event"] == "zeroed"))
    return {
        at: Zero(*(float(event[name]) for name in Zero._fields)) for at, event in events.items()
    }


def _index_by_tick(log: Log, messages: Iterable[dict[str, Any]]) -> dict[int, dict[str, Any]]:
    """Return messages by their tick as it stands in the log; without those whose tick is lost.

    A run in a loop that went on before begins with the frozen state of the tick before: -1.
    """
    ticks = log["tick"]
    before = int(ticks[0]) - 1 - int(log["missed"][0])
    found = {
        -1 if m["tick"] == before else int(np.searchsorted(ticks, m["tick"])): m for m in messages
    }
    return {
        at: message
        for at, message in found.items()
        if at < 0 or (at < len(ticks) and ticks[at] == message["tick"])
    }


def _read_gain_changes(log: Log) -> tuple[GainChange, ...]:
    """Return the gains behind the first, which are those that the run began with."""
    return tuple(
        GainChange(
            _find_tick_after(log, m),
            _read_controller(log, m),
            float(m["from_t_s"]),
            float(m["ramp_s"]),
        )
        for m in log.gains[1:]
    )


def _read_orders(log: Log) -> dict[int, Mapping[str, Any]]:
    runs = (e for e in log.events if e["event"] == "order" and e["do"] == "run")
    return {_find_tick_after(log, event): event for event in runs}


def _find_tick_after(log: Log, message: Mapping[str, Any]) -> int:
    """Return the first tick behind the one after which something was said."""
    return int(np.searchsorted(log["tick"], message["tick"], side="right"))


def _read_controller(log: Log, message: Mapping[str, Any]) -> ControllerSettings:
    gains = {name: value for name, value in message.items() if name not in _WHERE}
    try:
        raw = RawSettings(gains, {(): f"{log.path}:/pam/gains"})
        controller: ControllerSettings = validate_settings(
            SECTIONS["controller"], raw, "controller"
        )
    except ConfigError as error:
        raise NotReplayable(
            f"gains in {log.path} do not fit this version; "
            f"{_suggest_version(log)}. What does not fit:\n{error}"
        ) from error
    return controller


_WHERE = ("tick", "t_ns", "row", "from_t_s", "ramp_s")
"""What a message says beside its content."""


def _read_keyframes(log: Log) -> dict[int, TickState]:
    """Thaw the keyframes; those of another version, whose state has other parts, are left out."""
    like = first_state(Zero(0.0, 0.0), 0.0)
    names = keyframe_fields(like)
    return {
        at: thaw_state(like, [keyframe["state"][name] for name in names])
        for at, keyframe in _index_by_tick(log, log.keyframes).items()
        if keyframe["state"].keys() == set(names)
    }


def _find_losses(log: Log, *, begins_known: bool) -> frozenset[int]:
    gaps = np.diff(log["tick"]) - 1 != log["missed"][1:]
    lost = set((np.flatnonzero(gaps) + 1).tolist())
    return frozenset(lost | ({0} if log["tick"][0] != 0 and not begins_known else set()))


def find_absent_fields(log: Log) -> list[str]:
    """Return the fields that this version computes and the log, of another version, lacks."""
    return [field.name for field in RETICK_FIELDS if field.name not in log.columns]
