"""The parts of a log that a replay needs: the state, the setup and the inputs of every tick."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.calibration import Zero
from hal.converter import Output
from pamctl.control.law import LawSettings
from pamctl.exit_codes import ExitCode
from pamctl.log import Log
from pamctl.realtime.gain_ramp import GainRamp
from pamctl.realtime.tick import TickSetup, TickState, first_state, rezero_state
from pamctl.replay.stretch import REPLAY_INPUTS
from pamctl.settings.build import build_tick_setup, output_of
from pamctl.settings.resolve import RunSettings

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
    """Of what the log is a piece (`pamctl.log.cut`); empty for a whole log."""
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
