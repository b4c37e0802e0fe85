"""A run without a clock in this one process, for systems without rings in shared memory.

It is the same loop on the same simulated rig, with ring and recorder as everywhere, and gives the
same rows. No valve depends on it: if this process dies, the log ends with the last whole chunk.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from types import FrameType

from pamctl.exit_codes import Ending, ExitCode
from pamctl.log.run_meta import RunMeta
from pamctl.processes.backends import require_backend
from pamctl.processes.compose_loop import compose_loop
from pamctl.recording.journal import RingJournal, end_for_dead_loop, wait_for_recorder
from pamctl.recording.recorder_thread import RecordedRun
from pamctl.recording.ring import Ring
from pamctl.settings.resolve import RunSettings

_TELL_EVERY_S = 0.05


class _Watch:
    """Tells the progress; ends the run smoothly at the first Ctrl-C, at once at the second."""

    def __init__(self, ring: Ring, tell: Callable[[Mapping[str, float]], None]) -> None:
        self._ring, self._tell = ring, tell
        self._told_s = 0.0
        self._count = 0

    def __enter__(self) -> _Watch:
        self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._count += 1

    def find_stop(self, tick: int) -> Ending | None:
        now_s = time.monotonic()
        if now_s - self._told_s >= _TELL_EVERY_S and (newest := self._ring.latest_tick()):
            self._told_s = now_s
            self._tell(newest)
        return Ending(ExitCode.SIGINT, "stopped by SIGINT") if self._count else None

    def wants_abort(self) -> bool:
        return self._count > 1


def run_here(
    meta: RunMeta,
    settings: RunSettings,
    tell: Callable[[Mapping[str, float]], None],
) -> Ending:
    """Run a simulation to its end, with its log at `meta.log_path`; return how it ended.

    `tell` is called with the newest tick's columns from time to time. Raise `LogError` or OSError
    if the log cannot be written.
    """
    require_backend(settings)
    ring = Ring.in_memory(meta, settings.rig.loop.ring_rows)
    wait_for_recorder(ring)
    run = RecordedRun("run", ring)
    try:
        with _Watch(ring, tell) as watch:
            ending = compose_loop(settings, RingJournal(ring), watch).run()
    # The log keeps every tick until then.
    except Exception as error:
        ending = Ending(ExitCode.UNEXPECTED, f"{type(error).__name__}: {error}")
    end_for_dead_loop(ring, ending)
    run.finish()
    return ending
