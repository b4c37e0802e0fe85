"""Replay: the tick over a log's raw samples, and where it says something else than the log.

    raw samples, measured timing -> tick -> measurement, estimate, command, decision, output
    settings, times              -> program -> reference, zeros

What goes in is the log's; what comes out is compared with the log, field by field, to the
bit. Nothing that comes from the wall clock is in it: lateness and durations are what the
run met, and go in. The tick runs compiled; where it differs from the log, plain Python, in
which the log was made, has the last word.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from hal.calibration import Zero
from pamctl.control.experiment import Segment
from pamctl.log import Log
from pamctl.realtime.tick import first_state
from pamctl.replay.course_kernel import trace_course
from pamctl.replay.differences import Difference, Differences, StageField
from pamctl.replay.read_source import find_absent_fields, read_replay_source
from pamctl.replay.replay_source import BehindTheEnd, NotReplayable, ReplaySource
from pamctl.replay.tick_kernel import replay_stretch
from pamctl.replay.tick_replay import TickReplay, list_compared_fields
from pamctl.replay.tolerance import EXACT, Tolerances

__all__ = [
    "BehindTheEnd",
    "NotReplayable",
    "Replay",
    "list_compared_fields",
    "read_replay_source",
    "replay_log",
]


@dataclass(frozen=True)
class Replay:
    """What a replay found. Ticks are counted as they stand in the log, from 0."""

    recording: ReplaySource
    begin: int
    """The first tick that was replayed."""
    ticks: int
    """How many were replayed."""
    skipped: int
    """Ticks behind a loss, up to the next frozen state: nobody knows the state they began with."""
    unasked: int
    """Replayed ticks whose reference could not be asked for again, for the same reason."""
    fields: tuple[StageField, ...]
    """What was compared."""
    absent: tuple[str, ...]
    """What could not be, because the log, of another version, does not have it."""
    differences: tuple[Difference, ...]
    """Fields that differ, in the order in which they begin to."""
    took_s: float

    @property
    def is_equal(self) -> bool:
        """Whether all that was replayed is as in the log."""
        return not self.differences

    @property
    def is_whole(self) -> bool:
        """Whether every tick asked for could be replayed, reference included."""
        return not self.skipped and not self.unasked

    @property
    def speed(self) -> float:
        """Replayed time over the time it took."""
        t_s = self.recording.log.t
        return float(t_s[-1] - t_s[self.begin]) / self.took_s


def replay_log(
    log: Log, *, from_s: float | None = None, plain: bool = False, tolerances: Tolerances = EXACT
) -> Replay:
    """Replay a log from its first tick, or from the last frozen state up to `from_s` (s).

    `plain` runs the tick as the loop process does, without compiling it. Raises
    NotReplayable.
    """
    recording = read_replay_source(log)
    begin = 0 if from_s is None else recording.find_tick_before(from_s) + 1
    if not plain:
        _load_kernels(recording)
    began_s = time.perf_counter()
    run = TickReplay(recording, begin, Differences(tolerances), plain=plain)
    for stretch in recording.cut_stretches(begin):
        run.take(*stretch)
    if run.skipped == len(recording) - begin:
        raise NotReplayable(
            f"{log.path} has lost ticks before all that is left of it, and holds no frozen state "
            "behind them: nobody knows the state it goes on from"
        )
    return Replay(
        recording=recording,
        begin=begin,
        ticks=len(recording) - begin - run.skipped,
        skipped=run.skipped,
        unasked=run.unasked,
        fields=tuple(run.differences.compared),
        absent=tuple(find_absent_fields(log)),
        differences=run.differences.all(),
        took_s=time.perf_counter() - began_s,
    )


def _load_kernels(recording: ReplaySource) -> None:
    """Run over no tick at all: to compile, or load what was compiled, is no part of the speed."""
    setup = recording.setup_at(0)
    nowhere = first_state(setup, Zero(0.0, 0.0))
    replay_stretch(setup, recording.output, nowhere, recording.inputs(0, 0))
    trace_course([Segment(0, 1.0, 0.0, 0.0, 0.0)], 1.0, 0.0, np.empty(0))
