"""What a replay needs, taken from a log; or the reason why there is nothing to replay in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hal.calibration import Zero
from pamctl.control.law import ControllerSettings
from pamctl.json_text import to_json
from pamctl.log import Log
from pamctl.realtime.keyframe import keyframe_fields, thawed
from pamctl.realtime.tick import TickState, first_state
from pamctl.replay.recorded_run import Change, NotReplayable, Recording
from pamctl.replay.retick import RETICKED, Inputs
from pamctl.settings.problems import ConfigError
from pamctl.settings.resolve import SECTIONS, Raw, RunSettings, from_resolved, validated


def recording_of(log: Log) -> Recording:
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
    settings = _settings_of(log)
    keyframes, orders = _keyframes(log), _orders(log)
    return Recording(
        log=log,
        settings=settings,
        zeros=_zeros(log),
        # A single run begins with what is configured; one that was ordered, with what was set.
        gains=_controller(log, log.gains[0]) if orders else settings.controller,
        changes=_changes(log),
        orders=orders,
        stops=frozenset(_at_ticks(log, (e for e in log.events if e["event"] == "stopping"))),
        keyframes=keyframes,
        losses=_losses(log, begins_known=-1 in keyframes),
    )


def _refuse_imported(log: Log) -> None:
    if log.is_imported:
        raise NotReplayable(
            f"{log.path} is an imported measurement: no tick of pamctl made it, and there is "
            "nothing to replay in it; `pamctl compare` and `pamctl diagnose` work on it"
        )


def _require_columns(log: Log) -> None:
    needed = (*Inputs._fields, "valve_v", "applied_v")
    missing = [name for name in needed if name not in log.columns]
    if missing:
        raise NotReplayable(
            f"{log.path} lacks {', '.join(missing)}, which this version's tick needs; "
            f"{_replay_with_its_own(log)}"
        )


def _replay_with_its_own(log: Log) -> str:
    version = log.metadata.get("pamctl", {}).get("version", "that wrote it")
    return f"replay it with pamctl {version}"


def _settings_of(log: Log) -> RunSettings:
    if not log.config:
        raise NotReplayable(f"{log.path} carries no configuration (config.json): nothing to replay")
    try:
        return from_resolved(to_json(log.config).decode(), f"{log.path}:config.json")
    except ConfigError as error:
        raise NotReplayable(
            f"the configuration in {log.path} does not fit this version; "
            f"{_replay_with_its_own(log)}. What does not fit:\n{error}"
        ) from error


def _zeros(log: Log) -> dict[int, Zero]:
    events = _at_ticks(log, (event for event in log.events if event["event"] == "zeroed"))
    return {
        at: Zero(*(float(event[name]) for name in Zero._fields)) for at, event in events.items()
    }


def _at_ticks(log: Log, messages: Iterable[dict[str, Any]]) -> dict[int, dict[str, Any]]:
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


def _changes(log: Log) -> tuple[Change, ...]:
    """Return the gains behind the first, which are those that the run began with."""
    return tuple(
        Change(_after(log, m), _controller(log, m), float(m["from_t_s"]), float(m["ramp_s"]))
        for m in log.gains[1:]
    )


def _orders(log: Log) -> dict[int, Mapping[str, Any]]:
    runs = (e for e in log.events if e["event"] == "order" and e["do"] == "run")
    return {_after(log, event): event for event in runs}


def _after(log: Log, message: Mapping[str, Any]) -> int:
    """Return the first tick behind the one after which something was said."""
    return int(np.searchsorted(log["tick"], message["tick"], side="right"))


def _controller(log: Log, message: Mapping[str, Any]) -> ControllerSettings:
    gains = {name: value for name, value in message.items() if name not in _WHERE}
    try:
        raw = Raw(gains, {(): f"{log.path}:/pam/gains"})
        controller: ControllerSettings = validated(SECTIONS["controller"], raw, "controller")
    except ConfigError as error:
        raise NotReplayable(
            f"gains in {log.path} do not fit this version; "
            f"{_replay_with_its_own(log)}. What does not fit:\n{error}"
        ) from error
    return controller


_WHERE = ("tick", "t_ns", "row", "from_t_s", "ramp_s")
"""What a message says beside its content."""


def _keyframes(log: Log) -> dict[int, TickState]:
    """Thaw the keyframes; those of another version, whose state has other parts, are left out."""
    like = first_state(Zero(0.0, 0.0), 0.0)
    names = keyframe_fields(like)
    return {
        at: thawed(like, [keyframe["state"][name] for name in names])
        for at, keyframe in _at_ticks(log, log.keyframes).items()
        if keyframe["state"].keys() == set(names)
    }


def _losses(log: Log, *, begins_known: bool) -> frozenset[int]:
    gaps = np.diff(log["tick"]) - 1 != log["missed"][1:]
    lost = set((np.flatnonzero(gaps) + 1).tolist())
    return frozenset(lost | ({0} if log["tick"][0] != 0 and not begins_known else set()))


def not_in_log(log: Log) -> list[str]:
    """Return the fields that this version computes and the log, of another version, lacks."""
    return [field.name for field in RETICKED if field.name not in log.columns]
