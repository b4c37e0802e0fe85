"""Read from a log what a replay needs, or say why it cannot be replayed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from hal.backend import find_backends
from hal.calibration import Zero
from pamctl.control.law import LawSettings
from pamctl.control.law_registry import compare_law_source, explain_absent_law
from pamctl.json_text import to_json
from pamctl.log import Log
from pamctl.log.schema import CUT
from pamctl.realtime.tick import TickState, first_state, thaw_state
from pamctl.replay.replay_source import GainChange, NotReplayable, ReplaySource
from pamctl.replay.stretch import REPLAY_INPUTS, REPLAYED_FIELDS
from pamctl.settings.build import build_tick_setup
from pamctl.settings.problems import ConfigError
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    from_resolved,
    validate_settings,
)


def read_replay_source(log: Log) -> ReplaySource:
    """Read from a log what a replay needs; raise NotReplayable."""
    _refuse_imported(log)
    if not len(log):
        raise NotReplayable(f"{log.path} holds no ticks")
    _require_columns(log)
    if not log.grid.is_rising:
        raise NotReplayable(
            f"the ticks of {log.path} are not in order, by number or by time; "
            f"`pamctl log check {log.path}` lists all that is wrong"
        )
    _require_law(log)
    settings = _read_settings(log)
    orders = _read_orders(log)
    # A single run begins with what is configured; one that was ordered, with what was set.
    cut = log.metadata.get(CUT, {})
    gains_set = orders or (cut and log.gains)
    gains = _read_controller(log, log.gains[0]) if gains_set else settings.controller
    keyframes = _read_keyframes(log, settings.model_copy(update={"controller": gains}))
    return ReplaySource(
        log=log,
        settings=settings,
        zeros=_read_zeros(log),
        gains=gains,
        changes=_read_gain_changes(log),
        orders=orders,
        stops=frozenset(_index_by_tick(log, (e for e in log.events if e["event"] == "stopping"))),
        keyframes=keyframes,
        keyframe_names=frozenset.intersection(*(frozenset(k["state"]) for k in log.keyframes))
        if log.keyframes
        else frozenset(),
        law_change=compare_law_source(log.metadata.get("law", {}), _name_law(log)),
        cut=cut,
        losses=_find_losses(log, begins_known=-1 in keyframes),
    )


def _refuse_imported(log: Log) -> None:
    if log.is_imported:
        raise NotReplayable(
            f"{log.path} is an imported measurement: there is no tick of pamctl to "
            "replay in it; `pamctl compare` and `pamctl diagnose` work on it"
        )


def _name_law(log: Log) -> str:
    return str(log.config.get("controller", {}).get("law", ""))


def _require_law(log: Log) -> None:
    name = _name_law(log)
    absent = name and explain_absent_law(log.metadata.get("law", {}), name)
    if absent:
        raise NotReplayable(f"{log.path} cannot be replayed here: {absent}")


def _require_columns(log: Log) -> None:
    needed = (*REPLAY_INPUTS, "valve_v", "applied_v")
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
        config = _with_earlier_behaviour(log.config)
        return from_resolved(to_json(config).decode(), f"{log.path}:config.json")
    except ConfigError as error:
        _require_backend_of(log)
        raise NotReplayable(
            f"the configuration in {log.path} does not fit this version; "
            f"{_suggest_version(log)}. What does not fit:\n{error}"
        ) from error


def _with_earlier_behaviour(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the configuration of an older log with what was fixed when it was written.

    The pressure model of safety took one step in a late tick.
    """
    rig = config.get("rig", {})
    limits = {"pressure_model_step_s": 1.0, **rig.get("limits", {})}
    return {**config, "rig": {**rig, "limits": limits}}


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
    """Return messages by the place of their tick in the log, without those whose tick is lost.

    The frozen state at the start of an ordered run belongs to the tick before the log: place -1.
    """
    before = log.grid.first_tick - 1 - log.grid.missed_first
    found = {-1 if m["tick"] == before else log.grid.find(m["tick"]): m for m in messages}
    return {at: message for at, message in found.items() if at is not None}


def _read_gain_changes(log: Log) -> tuple[GainChange, ...]:
    """Return all gains but the first, which are those at the beginning of the run."""
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
    """Return the first tick after the tick of a message."""
    return log.grid.find_from(message["tick"] + 1)


def _read_controller(log: Log, message: Mapping[str, Any]) -> LawSettings:
    gains = {name: value for name, value in message.items() if name not in _WHERE}
    try:
        raw = RawSettings(gains, {(): f"{log.path}:/pam/gains"})
        controller: LawSettings = validate_settings(SECTIONS["controller"], raw, "controller")
    except ConfigError as error:
        raise NotReplayable(
            f"gains in {log.path} do not fit this version; "
            f"{_suggest_version(log)}. What does not fit:\n{error}"
        ) from error
    return controller


_WHERE = ("tick", "t_ns", "row", "from_t_s", "ramp_s")
"""Keys of a message beside its gains."""


def _read_keyframes(log: Log, settings: RunSettings) -> dict[int, TickState]:
    """Thaw the keyframes; numbers that an older log lacks are as before the first tick."""
    like = first_state(build_tick_setup(settings), Zero(0.0, 0.0))
    return {
        at: thaw_state(like, keyframe["state"])
        for at, keyframe in _index_by_tick(log, log.keyframes).items()
    }


def _find_losses(log: Log, *, begins_known: bool) -> frozenset[int]:
    lost_first = log.grid.first_tick != 0 and not begins_known
    return frozenset(log.grid.losses | ({0} if lost_first else set()))


def find_absent_fields(log: Log) -> list[str]:
    """Return the fields that this version computes and a log of another version lacks."""
    return [
        field.name
        for field in REPLAYED_FIELDS
        if field.stage != "compensation" and field.name not in log.columns
    ]
