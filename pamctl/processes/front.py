"""The front: starts the processes of a run, watches them, and finishes what one leaves undone.

    front - recorder
          - guardian    (none in a run without a clock)
          - loop

Each child sees the front's death as the end of a pipe. Ctrl-C reaches the front only, which
passes it on to the loop only.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from types import FrameType
from typing import NamedTuple

from hal.rig import Rig
from pamctl.exit_codes import Ending, ExitCode
from pamctl.processes.guardian_handle import LOOK_EVERY_S, Guardianship, start_loop
from pamctl.processes.interrupts import STOP_SIGNALS, block_signals
from pamctl.realtime.clock import LoopSettings
from pamctl.realtime.scheduling import Mode, raise_front_priority
from pamctl.recording.journal import end_for_dead_loop
from pamctl.recording.recorder import RECORDER_PATIENCE_S, spawn_recorder
from pamctl.recording.ring import RecorderFlag, Ring

_POLL_S = 0.05
_FINISH_PATIENCE_S = 60.0
"""A recorder that writes nothing for this time after the last row is killed."""

Progress = Callable[[Mapping[str, float], float], None]
"""Called with the newest tick's columns and the worst lateness (s) so far."""


class FrontReport(NamedTuple):
    """How a run ended, and what became of its log."""

    ending: Ending
    log_is_whole: bool
    note: str
    """What the user must know about the log; empty where all is well."""


def conduct_run(
    ring: Ring,
    rig: Rig,
    progress: Progress,
    mode: Mode,
    pace: LoopSettings,
    *,
    is_guarded: bool = True,
) -> FrontReport:
    """Run the loop on a fresh ring to its end; return when the log is on disk.

    Takes over the signals that end a run, and leaves them without effect: call it within
    `restore_signals`. `rig` is not opened here: it is made safe
    where neither loop nor guardian is left to do it. `mode` is for this process alone: it
    says whether the front may be scheduled in real time while it watches. `pace` says
    how long the loop may be silent. A run without a clock is not guarded.
    """
    with _SignalForwarder() as signals:
        with block_signals():
            recorder = spawn_recorder(ring.path)
            loop, guardian = start_loop(ring, rig, pace, is_guarded=is_guarded)
        signals.start_forwarding(loop)
        with raise_front_priority(mode):
            _watch(ring, loop, recorder, guardian, progress)
        ending = guardian.judge_ending(read_ending(loop))
        end_for_dead_loop(ring, ending)
        try:
            return close_log(ring, recorder, ending)
        finally:
            guardian.dismiss()  # only now: if the front dies here, the guardian finishes the log


class _SignalForwarder:
    """Passes this process's signals on to the loop, also those that came before the loop."""

    def __init__(self) -> None:
        self._loop: subprocess.Popen[bytes] | None = None
        self._early: list[int] = []

    def __enter__(self) -> _SignalForwarder:
        for number in STOP_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # ignored under nohup
                signal.signal(number, self._forward)
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the handlers: without a loop they do nothing."""

    def start_forwarding(self, loop: subprocess.Popen[bytes]) -> None:
        self._loop = loop
        for number in self._early:
            self._forward(number, None)

    def _forward(self, number: int, frame: FrameType | None) -> None:
        if self._loop is None:
            self._early.append(number)
        elif self._loop.poll() is None:
            self._loop.send_signal(number)


def _watch(
    ring: Ring,
    loop: subprocess.Popen[bytes],
    recorder: subprocess.Popen[bytes],
    guardian: Guardianship,
    progress: Progress,
) -> None:
    """Return when the loop has ended; end it when the recorder has."""
    shown_s = 0.0
    with closing(_Deaths([loop.pid, recorder.pid, guardian.pid])) as deaths:
        while loop.poll() is None:
            if recorder.poll() is not None:
                ring.raise_flag(RecorderFlag.FAILED)
            guardian.look(loop)
            now_s = time.monotonic()
            if now_s - shown_s >= _POLL_S and (tick := ring.latest_tick()) is not None:
                shown_s = now_s
                progress(tick, ring.worst_late_ns * 1e-9)
            deaths.wait(_POLL_S if guardian.pid is None else LOOK_EVERY_S)


class _Deaths:
    """Sleeps until one of the processes dies; each death ends one sleep."""

    def __init__(self, pids: Sequence[int | None]) -> None:
        self._poll = select.poll()
        # They are children that nobody has waited for: their ids cannot belong to others yet.
        self._fds = [os.pidfd_open(pid) for pid in pids if pid is not None]
        for fd in self._fds:
            self._poll.register(fd, select.POLLIN)

    def wait(self, seconds: float) -> None:
        for fd, _ in self._poll.poll(seconds * 1e3):
            self._poll.unregister(fd)

    def close(self) -> None:
        for fd in self._fds:
            os.close(fd)


def read_ending(loop: subprocess.Popen[bytes]) -> Ending:
    """Return what a dead loop process said last, or how it died."""
    said, _ = loop.communicate()
    try:
        report = json.loads(said.splitlines()[-1])
        return Ending(ExitCode(report["code"]), report["reason"])
    except (ValueError, KeyError, TypeError, IndexError):
        code = loop.returncode
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"left with {code}"
        return Ending(ExitCode.UNEXPECTED, f"the loop process {how}")


def close_log(ring: Ring, recorder: subprocess.Popen[bytes], ending: Ending) -> FrontReport:
    """Wait for the recorder; where it is dead, start it again: it goes on where the file ends."""
    complaint = _await_recorder(recorder, ring)
    if not complaint:
        ring.unlink()
        return FrontReport(ending, True, "")
    if not ring.recorder_flags & RecorderFlag.READY:
        # The recorder never began: there is no log to finish and no tick to save.
        ring.unlink()
        return FrontReport(Ending(ExitCode.UNEXPECTED, complaint), False, "")
    worst = ending if ending.code else Ending(ExitCode.UNEXPECTED, complaint)
    note = complaint
    if not ring.recorder_flags & RecorderFlag.FINISHED:
        problem = _await_recorder(spawn_recorder(ring.path), ring)
        if not ring.recorder_flags & RecorderFlag.FINISHED:
            note += f"; the log could not be finished ({problem}). Its last ticks are kept in "
            note += f"{ring.path}: make room, and the next `pamctl run` finishes it"
            return FrontReport(worst, False, note)
    # The front's recorder did so, or the one that a loop leaves behind when it misses the first.
    if ring.recorder_pid != recorder.pid:
        note += f"; the log was finished from the ring: {ring.meta.log_path}"
    ring.unlink()
    return FrontReport(worst, not ring.recorder_flags & RecorderFlag.GAPS, note)


def _await_recorder(recorder: subprocess.Popen[bytes], ring: Ring) -> str:
    """Let the recorder finish; return why it did not, be it killed here.

    It must show life all the time, and get on with its rows within a minute, or read on in the
    file that it goes on with.
    """
    fault = ""
    seen, beaten_s = (ring.recorder_beats, ring.tail), time.monotonic()
    moved_s = beaten_s
    while recorder.poll() is None:
        now, now_s = (ring.recorder_beats, ring.tail), time.monotonic()
        if now[0] != seen[0]:
            beaten_s = now_s
        if now[1] != seen[1]:
            moved_s = now_s
        seen = now
        if now_s - beaten_s > RECORDER_PATIENCE_S:
            fault = f"the recorder gave no sign of life for {RECORDER_PATIENCE_S:g} s"
        elif now_s - moved_s > _FINISH_PATIENCE_S:
            fault = f"the recorder did not finish the log within {_FINISH_PATIENCE_S:g} s"
        if fault:
            recorder.kill()
            recorder.wait()
            break
        time.sleep(_POLL_S)
    _, said = recorder.communicate()
    if recorder.returncode == 0:
        return ""
    complaint = said.decode(errors="replace").strip().removeprefix("recorder: ")
    return complaint or fault or f"the recorder died with {recorder.returncode}"
