"""The tree of processes of one loop, and the front, which starts it and finishes what it leaves.

    front - guardian
          - loop
          - recorder  one for each run

A run of `pamctl run` has a tree of its own; a daemon's loop outlives its runs, as
`daemon/session.py` has it. Each child sees the front's death as the end of a pipe. Ctrl-C reaches
the front only, which passes it on to the loop only.
"""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from types import FrameType

from hal.child import child_command
from hal.rig import Rig
from pamctl.exit_codes import Ending, ExitCode
from pamctl.processes.guardian_handle import LOOK_EVERY_S, Guardianship
from pamctl.processes.interrupts import STOP_SIGNALS, block_signals
from pamctl.realtime.clock import LoopSettings
from pamctl.realtime.scheduling import Mode, raise_front_priority
from pamctl.recording.recorded_run import LogReport, ProcessRecordedRun
from pamctl.recording.ring import Ring

_SHOW_EVERY_S = 0.05

Progress = Callable[[Mapping[str, float], float], None]
"""Called with the newest tick's columns and the worst lateness (s) so far."""


class LoopTree:
    """A loop process, its guardian, and the run that is recorded now."""

    def __init__(
        self, ring: Ring, rig: Rig, pace: LoopSettings, run: ProcessRecordedRun | None = None
    ) -> None:
        """Start the loop of `run` on its ring; without a run, the loop of a session.

        `rig` is not open: it is made safe where neither loop nor guardian is left to do it. `pace`
        says how long the loop may be silent.
        """
        self.run = run
        words = [ring.path, *(["session"] if run is None else [])]
        # The loop inherits the block and lifts it when it has handlers: a signal that comes while
        # it starts waits, instead of killing it.
        with block_signals():
            guardian = _spawn("pamctl.processes.guardian_main", ring.path)
            self._loop = _spawn("pamctl.processes.loop_main", *words)
            self._guardian = Guardianship(ring, guardian, rig, pace)
            ring.loop_pid = self._loop.pid

    @property
    def is_alive(self) -> bool:
        """The loop process lives."""
        return self._loop.poll() is None

    def send_signal(self, number: int, frame: FrameType | None = None) -> None:
        """Pass a signal on to the loop if it lives; also as a handler of the signal."""
        if self.is_alive:
            self._loop.send_signal(number)

    def look(self) -> None:
        """See whether guardian, loop and recorder live; call it every `LOOK_EVERY_S`."""
        self._guardian.look(self._loop)
        if self.run is not None:
            self.run.look()

    def conclude(self, failing: str = "") -> tuple[Ending, LogReport | None]:
        """Return how a dead loop ended, and what became of the log of its run.

        The valve is safe afterwards. `failing` says why the loop was killed, if it was.
        """
        ending = _read_ending(self._loop)
        ending = self._guardian.judge_ending(ending._replace(reason=failing or ending.reason))
        try:
            return ending, None if self.run is None else self.run.finish(ending)
        finally:
            # Only now: if the front dies here, the guardian finishes the log.
            self._guardian.dismiss()


def conduct_run(
    ring: Ring, rig: Rig, progress: Progress, mode: Mode, pace: LoopSettings
) -> LogReport:
    """Run the loop on a fresh ring to its end; return when the log is on disk.

    Takes over the signals that end a run, and leaves them without effect: call it within
    `restore_signals`. `mode` is for this process alone: it says whether the front may be scheduled
    in real time while it watches. For `rig` and `pace` see `LoopTree`.
    """
    with block_signals():
        tree = LoopTree(ring, rig, pace, ProcessRecordedRun("run", ring))
        for number in STOP_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # ignored under nohup
                signal.signal(number, tree.send_signal)
    shown_s = 0.0
    with raise_front_priority(mode):
        while tree.is_alive:
            tree.look()
            now_s = time.monotonic()
            if now_s - shown_s >= _SHOW_EVERY_S and (tick := ring.latest_tick()) is not None:
                shown_s = now_s
                progress(tick, ring.worst_late_ns * 1e-9)
            time.sleep(LOOK_EVERY_S)
    _, report = tree.conclude()
    assert report is not None
    return report


def _spawn(module: str, *arguments: object) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        child_command(module, *arguments),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        process_group=0,
    )


def _read_ending(loop: subprocess.Popen[bytes]) -> Ending:
    """Return what a dead loop process said last, or how it died."""
    said, _ = loop.communicate()
    try:
        report = json.loads(said.splitlines()[-1])
        return Ending(ExitCode(report["code"]), report["reason"])
    except (ValueError, KeyError, TypeError, IndexError):
        code = loop.returncode
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"left with {code}"
        return Ending(ExitCode.UNEXPECTED, f"the loop process {how}")
