"""What a replay needs of a log: the state, the setup and the inputs of every tick, or why not.

`replay_stretch` runs the ticks of a stretch with the function that the loop process calls.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.backend import find_backends
from hal.calibration import Output, Zero
from pamctl.base.errors import ConfigError, ExitCode
from pamctl.base.texts import to_json
from pamctl.control.law import LawSettings
from pamctl.control.law_registry import compare_law_source, explain_absent_law
from pamctl.kernel.calls import PlainCall, recall
from pamctl.log import Log
from pamctl.log.schema import CUT
from pamctl.realtime.gain_ramp import GainRamp
from pamctl.realtime.run_ticks import NOWHERE, Guide, LoggedRig, Nothing, run_ticks, start_loop
from pamctl.realtime.tick import TickSetup, TickState, first_state, rezero_state, thaw_state
from pamctl.realtime.tick_runner import UPDATES
from pamctl.recording.rows import make_rows, row_dtype
from pamctl.settings.build import build_tick_setup, output_of
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    from_resolved,
    validate_settings,
)
from pamctl.signals import COMPENSATION_FIELDS, TICK_FIELDS, Field, Reference, list_tick_fields

_OF_EVERY_RUN = tuple(
    field
    for field in TICK_FIELDS
    if field.stage in ("measurement", "estimate", "command", "decision")
    or field.name == "applied_v"
)
REPLAYED_FIELDS: tuple[Field, ...] = (*_OF_EVERY_RUN, *COMPENSATION_FIELDS)
"""The fields that `replay_stretch` computes, in the order of its rows.

Those of a compensation are NaN in a run that has none.
"""
APPLIED_ROW = len(_OF_EVERY_RUN) - 1
"""The row of `applied_v`."""


_OF_RIG = LoggedRig._fields[:-1]
REPLAY_INPUTS = (*_OF_RIG, *Reference._fields)
"""The columns that a replay takes from the log: timing, raw sample, and reference."""


def replay_stretch(
    setup: TickSetup,
    output: Output,
    state: TickState,
    inputs: Mapping[str, NDArray[Any]],
    *,
    plain: bool = False,
) -> tuple[TickState, NDArray[np.float64]]:
    """Run the ticks of a stretch as machine code or, as the reference, in plain Python.

    `inputs` has the columns `REPLAY_INPUTS`, each of shape (n,). Returns the state after the last
    tick, and the rows, shape (len(REPLAYED_FIELDS), n). The reference is the logged one: if the
    program asks for another reference, that is a difference of its own, and must not hide the
    others.
    """
    n, compensates = len(inputs["tick"]), setup.compensation is not None
    columns: list[Any] = [np.ascontiguousarray(inputs[name]) for name in _OF_RIG]
    table = np.column_stack([inputs[name] for name in Reference._fields]).ravel()
    buffer = make_rows(compensates, n, None)
    arguments = {
        "setup": setup,
        "loop": start_loop(state, 0, 0),
        "rig": LoggedRig._make([*columns, output]),
        "inner": Nothing(),
        "outer": Nothing(),
        "guide": Guide(NOWHERE, table, True),
        "rows": buffer,
        "n": n,
    }
    call = (PlainCall if plain else recall)(run_ticks, arguments, UPDATES)
    call.run()
    rows = np.full((len(REPLAYED_FIELDS), n), np.nan)
    ticks: Any = np.frombuffer(buffer.buffer, row_dtype(list_tick_fields(compensates), None))[
        "columns"
    ]
    for row, field in zip(rows, REPLAYED_FIELDS, strict=True):
        if field.name in ticks.dtype.names:
            row[:] = ticks[field.name]
    return call.get("loop").state, rows


LONGEST_STRETCH = 1 << 13
"""Ticks that are replayed at once: as many as memory holds easily, in a log of any length."""


class NotReplayable(Exception):
    """The log cannot be replayed, or not by this version. The message says why, and what to do."""

    exit_code = ExitCode.BAD_DATA


class BehindTheEnd(NotReplayable):
    """The log ends before the requested time."""

    exit_code = ExitCode.USAGE


class GainChange(NamedTuple):
    """Gains that were changed on a ramp while the law ran."""

    tick: int
    """The first tick with the new gains, as its place in the log."""
    controller: LawSettings
    from_t_s: float
    ramp_s: float


@dataclass(frozen=True)
class ReplaySource:
    """A log, prepared for a replay. A tick's number is its place in the log, from 0."""

    log: Log
    settings: RunSettings
    zeros: Mapping[int, Zero]
    """The sensors' zeros, by the first tick that uses them."""
    gains: LawSettings
    """The gains at the beginning of the run."""
    changes: tuple[GainChange, ...]
    """The changes of the gains during the run, in order."""
    orders: Mapping[int, Mapping[str, Any]]
    """Runs that were ordered from a daemon's loop, by their first tick."""
    stops: frozenset[int]
    """Ticks in which the run began to stop."""
    keyframes: Mapping[int, TickState]
    """The frozen state after a tick, by tick."""
    keyframe_names: frozenset[str]
    """The numbers that every keyframe of the log holds."""
    law_change: str
    """How the law's source differs from the one that made the log; empty if it does not."""
    cut: Mapping[str, str]
    """Of what the log is a piece (`pamctl.log.edit`); empty for a whole log."""
    losses: frozenset[int]
    """Ticks with a loss before them: the run did not miss those ticks, but the log lost them."""

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.log)

    def inputs(self, begin: int, end: int) -> dict[str, NDArray[Any]]:
        """Return the columns `REPLAY_INPUTS` of the ticks from `begin` to before `end`."""
        return {name: self.log.columns[name][begin:end] for name in REPLAY_INPUTS}

    def cut_stretches(self, begin: int) -> list[tuple[int, int]]:
        """Cut the ticks from `begin` on wherever state or gains change, or a state is known."""
        after_keyframes = {tick + 1 for tick in self.keyframes}
        cuts = {*self.zeros, *self.losses, *after_keyframes, *self.orders, begin, len(self)}
        cuts.update(*(self._find_ramp(change) for change in self.changes))
        cuts.update(range(begin, len(self), LONGEST_STRETCH))
        return list(pairwise(sorted(cut for cut in cuts if begin <= cut <= len(self))))

    def run_stretches(
        self, begin: int, setup: TickSetup | None = None, *, plain: bool = False
    ) -> Iterator[tuple[int, int, TickState | None, NDArray[np.float64]]]:
        """Run the ticks from `begin` on; yield the ends of each stretch, the state after it, rows.

        `setup` takes the place of the log's own. The state is None, and there are no rows, where
        the log lost the state before a stretch.
        """
        after = self.keyframes.get(begin - 1)
        for start, end in self.cut_stretches(begin):
            state = self.state_at(start, after)
            if state is None:
                yield start, end, None, np.empty((len(REPLAYED_FIELDS), 0))
                after = self.keyframes.get(end - 1)
                continue
            used = setup or self.setup_at(start)
            if type(state.law) is not type(used.armed):
                state = state._replace(law=used.armed)  # another law's memory means nothing here
            inputs = self.inputs(start, end)
            after, rows = replay_stretch(used, self.output, state, inputs, plain=plain)
            yield start, end, after, rows

    def state_at(self, tick: int, after_last: TickState | None) -> TickState | None:
        """Return the state before a tick; None if ticks before it are lost.

        `after_last` is the state after the previous tick; None if it is unknown.
        """
        lost = tick in self.losses
        zero = self.zeros.get(tick)
        if zero is not None and tick == 0 and not lost:
            return first_state(self.setup_at(0), zero)
        if lost or after_last is None or zero is None:
            return None if lost else after_last
        return rezero_state(self.setup_at(tick), after_last, zero)

    def _find_ramp(self, change: GainChange) -> range:
        """Return the ticks of a ramp, and the first tick with the final gains.

        Rounding may end the ramp a tick later than the sum of its times says.
        """
        end = self._find_time(change.from_t_s + change.ramp_s, change.tick)
        return range(change.tick, min(end + 2, len(self)))

    def _find_time(self, t_s: float, begin: int) -> int:
        """Return the first tick from `begin` on that is not before `t_s`."""
        for start in range(begin, len(self), LONGEST_STRETCH):
            times_s = self.log.t[start : start + LONGEST_STRETCH]
            if times_s[-1] >= t_s:
                return start + int(np.searchsorted(times_s, t_s))
        return len(self)

    def setup_at(self, tick: int) -> TickSetup:
        """Return the setup of a tick; on a ramp it applies to this tick only."""
        tuning = GainRamp(self._first_setup, self.gains)
        for change in self.changes:
            if change.tick <= tick:
                tuning.change(change.controller, change.from_t_s, change.ramp_s)
        return tuning.at(float(self.log.t[tick]))

    @cached_property
    def _first_setup(self) -> TickSetup:
        return build_tick_setup(self.settings.model_copy(update={"controller": self.gains}))

    @cached_property
    def output(self) -> Output:
        """The converter of the valve's output."""
        return output_of(self.settings)

    def find_begin(self) -> int:
        """Return the first tick to replay: of a piece, the one after its first frozen state."""
        if not (self.cut and 0 in self.losses):
            return 0
        if not self.keyframes:
            raise NotReplayable(
                f"{self.log.path} was cut from {self.cut['source']} and holds no frozen state "
                "(a run has one each second): cut a longer piece, or replay the whole log"
            )
        first = min(self.keyframes) + 1
        # Ticks that were lost later are no matter of the cut: then all is replayed that can be.
        return 0 if any(0 < loss < first for loss in self.losses) else first

    def find_tick_before(self, t_s: float) -> int:
        """Return the last tick with a keyframe at or before `t_s`, or -1."""
        times_s = self.log.t
        if not t_s <= times_s[-1]:
            raise BehindTheEnd(
                f"{self.log.path} ends at {times_s[-1]:g} s: there is nothing from {t_s:g} s on"
            )
        if not self.keyframes and t_s > times_s[0]:
            raise NotReplayable(
                f"{self.log.path} has no frozen state that this version can read; "
                "replay it from the beginning"
            )
        known = sorted(tick for tick in self.keyframes if tick >= 0)
        after = bisect_right(known, t_s, key=lambda tick: float(times_s[tick]))
        return known[after - 1] if after else -1


def read_replay_source(log: Log) -> ReplaySource:
    """Read from a log what a replay needs; raise NotReplayable."""
    if log.is_imported:
        raise NotReplayable(
            f"{log.path} is an imported measurement: there is no tick of pamctl to "
            "replay in it; `pamctl compare` and `pamctl diagnose` work on it"
        )
    if not len(log):
        raise NotReplayable(f"{log.path} holds no ticks")
    _require_columns(log)
    if not log.grid.is_rising:
        raise NotReplayable(
            f"the ticks of {log.path} are not in order, by number or by time; "
            f"`pamctl log check {log.path}` lists all that is wrong"
        )
    law, law_source = (
        str(log.config.get("controller", {}).get("law", "")),
        log.metadata.get("law", {}),
    )
    if absent := law and explain_absent_law(law_source, law):
        raise NotReplayable(f"{log.path} cannot be replayed here: {absent}")
    settings = _read_settings(log)
    runs = (e for e in log.events if e["event"] == "order" and e["do"] == "run")
    orders = {_find_tick_after(log, event): event for event in runs}
    # A single run begins with what is configured; one that was ordered, with what was set.
    cut = log.metadata.get(CUT, {})
    gains_set = orders or (cut and log.gains)
    gains = _read_controller(log, log.gains[0]) if gains_set else settings.controller
    keyframes = _read_keyframes(log, settings.model_copy(update={"controller": gains}))
    lost_first = log.grid.first_tick != 0 and -1 not in keyframes
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
        law_change=compare_law_source(law_source, law),
        cut=cut,
        losses=frozenset(log.grid.losses | ({0} if lost_first else set())),
    )


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
        # As it was before it was mended: the pressure model took one step in a late tick.
        rig = log.config.get("rig", {})
        limits = {"pressure_model_step_s": 1.0, **rig.get("limits", {})}
        config = {**log.config, "rig": {**rig, "limits": limits}}
        return from_resolved(to_json(config).decode(), f"{log.path}:config.json")
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
