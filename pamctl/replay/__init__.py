"""Replay a log: run the tick again on its raw samples, and compare every field to the bit.

    raw samples, measured timing -> tick -> measurement, estimate, command, decision, output
    settings, times              -> program -> reference, zeros

Read `replay_source.py` first, then `tick_replay.py` and `program_replay.py`.

The inputs are the logged ones, lateness and durations included: no clock is read. The tick runs
compiled. If its results differ from the log, plain Python decides, because it made the log.
"""

from __future__ import annotations

import time

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
    read_replay_source,
    replay_stretch,
)
from pamctl.replay.tick_replay import EXACT, Replay, Tolerances

__all__ = ["BehindTheEnd", "NotReplayable", "Replay", "read_replay_source", "replay_log"]


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
    found = Replay(recording, begin, tolerances, plain=plain)
    for stretch in recording.run_stretches(begin, plain=plain):
        found.take(*stretch)
    found.took_s = time.perf_counter() - began_s
    if not found.ticks:
        raise NotReplayable(
            f"{log.path} has lost its first ticks and has no frozen state after them: "
            "the state to start from is unknown"
        )
    return found


def _load_kernels(recording: ReplaySource) -> None:
    """Run on zero ticks: compiling, or loading compiled code, does not count for the speed."""
    setup = recording.setup_at(0)
    nowhere = first_state(setup, Zero(0.0, 0.0))
    replay_stretch(setup, recording.output, nowhere, recording.inputs(0, 0))
    trace_course(Course([Segment(0, 1.0, 0.0, 0.0, 0.0)]), 0.0, np.empty(0))
