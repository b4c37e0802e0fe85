"""Replay a log: run the tick again on its raw samples, and compare every field to the bit.

    raw samples, measured timing -> tick -> measurement, estimate, command, decision, output
    settings, times              -> program -> reference, zeros

Read `replay_source.py` first, then `tick_replay.py` and `program_replay.py`.

The inputs are the logged ones, lateness and durations included: no clock is read. The tick runs
compiled. If its results differ from the log, plain Python decides, because it made the log.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from hal.calibration import Zero
from pamctl.control.course import Course, Segment
from pamctl.log import Log
from pamctl.realtime.tick import first_state
from pamctl.replay.program_replay import trace_course
from pamctl.replay.replay_source import (
    BehindTheEnd,
    NotReplayable,
    ReplaySource,
    find_absent_fields,
    read_replay_source,
    replay_stretch,
)
from pamctl.replay.tick_replay import (
    EXACT,
    Difference,
    Differences,
    StageField,
    TickReplay,
    Tolerances,
    list_compared_fields,
)

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
    """The result of a replay. A tick's number is its place in the log, from 0."""

    recording: ReplaySource
    begin: int
    """The first replayed tick."""
    ticks: int
    """Number of replayed ticks."""
    skipped: int
    """Ticks after a loss, up to the next frozen state: the state before them is unknown."""
    unasked: int
    """Replayed ticks whose reference could not be computed again, for the same reason."""
    fields: tuple[StageField, ...]
    """The compared fields."""
    absent: tuple[str, ...]
    """Fields that could not be compared, because the log of another version lacks them."""
    differences: tuple[Difference, ...]
    """Fields that differ, in the order of their first difference."""
    took_s: float

    @property
    def is_equal(self) -> bool:
        """Whether every tick was replayed, and equals the log.

        The ticks that a run missed are none of the log's: nothing else may be left out.
        """
        return self.is_whole and not self.differences

    @property
    def is_whole(self) -> bool:
        """Whether every tick could be replayed, with its reference."""
        return not self.skipped and not self.unasked

    @property
    def speed(self) -> float:
        """Replayed time divided by the time that the replay took."""
        t_s = self.recording.log.t
        return float(t_s[-1] - t_s[self.begin]) / self.took_s


def replay_log(
    log: Log, *, from_s: float | None = None, plain: bool = False, tolerances: Tolerances = EXACT
) -> Replay:
    """Replay a log from its first tick, or from the last frozen state before `from_s` (s).

    `plain` runs the tick as the loop process does, not compiled. Raises NotReplayable.
    """
    recording = read_replay_source(log)
    begin = recording.find_begin() if from_s is None else recording.find_tick_before(from_s) + 1
    if not plain:
        _load_kernels(recording)
    began_s = time.perf_counter()
    run = TickReplay(recording, begin, Differences(tolerances), plain=plain)
    for stretch in recording.run_stretches(begin, plain=plain):
        run.take(*stretch)
    if run.skipped == len(recording) - begin:
        raise NotReplayable(
            f"{log.path} has lost its first ticks and has no frozen state after them: "
            "the state to start from is unknown"
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
    """Run on zero ticks: compiling, or loading compiled code, does not count for the speed."""
    setup = recording.setup_at(0)
    nowhere = first_state(setup, Zero(0.0, 0.0))
    replay_stretch(setup, recording.output, nowhere, recording.inputs(0, 0))
    trace_course(Course([Segment(0, 1.0, 0.0, 0.0, 0.0)]), 0.0, np.empty(0))
