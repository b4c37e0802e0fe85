"""A run without a clock, in this one process: no valve depends on it.

It is the same loop on the same simulated rig, with ring and recorder as everywhere; the recorder is
a thread. If this process dies, the next start finishes the log. On a system without rings in shared
memory it ends with the last whole chunk.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping

from pamctl.exit_codes import Ending
from pamctl.log.run_meta import RunMeta
from pamctl.processes.backends import new_ring_path
from pamctl.processes.loop_main import compose_loop, run_to_ending
from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.clock import LoopSettings
from pamctl.recording.journal import RingJournal, wait_for_recorder
from pamctl.recording.recorded_run import LogReport, ThreadRecordedRun
from pamctl.recording.ring import Ring
from pamctl.settings.resolve import RunSettings

_TELL_EVERY_S = 0.05


class _Watch(LoopSupervisor):
    """Tells the progress, too."""

    def __init__(
        self, ring: Ring, pace: LoopSettings, tell: Callable[[Mapping[str, float]], None]
    ) -> None:
        super().__init__(ring, None, pace, patient=True)
        self._tell = tell
        self._told_s = 0.0

    def find_stop(self, tick: int) -> Ending | None:
        now_s = time.monotonic()
        if now_s - self._told_s >= _TELL_EVERY_S and (newest := self._ring.latest_tick()):
            self._told_s = now_s
            self._tell(newest)
        return super().find_stop(tick)


def run_here(
    meta: RunMeta,
    settings: RunSettings,
    tell: Callable[[Mapping[str, float]], None],
) -> LogReport:
    """Run a simulation to its end, with its log at `meta.log_path`; return how it ended.

    `tell` is called with the newest tick's columns from time to time. Takes over the signals that
    end a run: call it within `restore_signals`. Raise `RecorderError` if there can be no log.
    """
    rows = settings.rig.loop.ring_rows
    has_rings = sys.platform == "linux"
    ring = Ring.create(new_ring_path(), meta, rows) if has_rings else Ring.in_memory(meta, rows)
    wait_for_recorder(ring)
    run = ThreadRecordedRun("run", ring)
    watch = _Watch(ring, settings.rig.loop, tell)
    watch.listen()
    ending = run_to_ending(lambda: compose_loop(settings, RingJournal(ring), watch).run())
    report = run.finish(ending)
    ring.close()
    return report
