"""A run that is recorded: its ring, its recorder, and how its log is finished.

The recorder is a process of its own, or a thread where the loop runs in this process.
"""

from __future__ import annotations

import subprocess
import threading
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from pamctl.base.errors import Ending, ExitCode
from pamctl.recording.journal import StandStill, end_for_dead_loop
from pamctl.recording.recorder import RECORDER_PATIENCE_S, RecorderError, record, spawn_recorder
from pamctl.recording.ring import RecorderFlag, Ring

_POLL_S = 0.05
_FINISH_PATIENCE_S = 60.0
"""A recorder that writes nothing for this time after the last row is killed."""


class LogReport(NamedTuple):
    """How a run ended, and what became of its log."""

    ending: Ending
    log_is_whole: bool
    note: str
    """What the user must know about the log; empty where all is well."""


class RecordedRun(ABC):
    """One run: its log, and the ring that its ticks go through."""

    def __init__(self, name: str, ring: Ring) -> None:
        """`name` is what was asked for."""
        self.name, self.ring = name, ring
        self.log = Path(ring.meta.log_path)

    @property
    @abstractmethod
    def recorder_pid(self) -> int:
        """The process of the recorder."""

    @abstractmethod
    def _await_recorder(self) -> str:
        """Let the recorder finish; return why the log is not whole, nothing where it is."""

    @property
    def is_over(self) -> bool:
        """The loop has put its last row."""
        with suppress(ValueError):  # just closed
            return bool(self.ring.loop_done)
        return True

    def finish(self, ending: Ending) -> LogReport:
        """Return when the log of a run that is over is on disk; its loop may be dead.

        Where its recorder has died, another one goes on where the file ends.
        """
        ring = self.ring
        end_for_dead_loop(ring, ending)
        complaint = self._await_recorder()
        if not complaint:
            ring.unlink()
            return LogReport(ending, True, "")
        if not ring.recorder_flags & RecorderFlag.READY:
            # The recorder never began: there is no log to finish and no tick to save.
            ring.unlink()
            return LogReport(Ending(ExitCode.UNEXPECTED, complaint), False, "")
        worst = ending if ending.code else Ending(ExitCode.UNEXPECTED, complaint)
        note = complaint
        if not ring.recorder_flags & RecorderFlag.FINISHED:
            if not ring.is_file:
                return LogReport(worst, False, note)
            problem = await_process(spawn_recorder(ring.path), ring, _FINISH_PATIENCE_S)
            if not ring.recorder_flags & RecorderFlag.FINISHED:
                note += f"; the log could not be finished ({problem}). Its last ticks are kept in "
                note += f"{ring.path}: make room, and the next `pamctl run` finishes it"
                return LogReport(worst, False, note)
        # The recorder from above did so, or the one that a loop leaves when it misses the first.
        if ring.recorder_pid != self.recorder_pid:
            note += f"; the log was finished from the ring: {ring.meta.log_path}"
        ring.unlink()
        return LogReport(worst, not ring.recorder_flags & RecorderFlag.GAPS, note)


class ProcessRecordedRun(RecordedRun):
    """A run whose recorder is a process."""

    def __init__(self, name: str, ring: Ring) -> None:
        """Start the recorder of the ring."""
        super().__init__(name, ring)
        self.recorder = spawn_recorder(ring.path)

    @property
    def recorder_pid(self) -> int:
        """The process of the recorder."""
        return self.recorder.pid

    def look(self) -> None:
        """Tell the loop of a recorder that has died."""
        has_ended = self.recorder.poll() is not None  # asked first: it ends after a run
        if has_ended and not self.is_over:
            self.ring.raise_flag(RecorderFlag.FAILED)

    def _await_recorder(self) -> str:
        return await_process(self.recorder, self.ring)


class ThreadRecordedRun(RecordedRun):
    """A run whose recorder is a thread; as the owner of the recording it never leaves."""

    gone = False

    def __init__(self, name: str, ring: Ring) -> None:
        """Open the log of the ring; raise `RecorderError` where it cannot be written."""
        super().__init__(name, ring)
        self._complaint = ""
        self._has_ended = threading.Event()
        self._thread = threading.Thread(target=self._record, name="recorder", daemon=True)
        self._thread.start()
        while not ring.recorder_flags & RecorderFlag.READY and self._thread.is_alive():
            self._has_ended.wait(1e-3)
        if not ring.recorder_flags & RecorderFlag.READY:
            problem = self.finish(Ending(ExitCode.OK, "")).ending.reason
            ring.close()
            raise RecorderError(problem)

    @property
    def recorder_pid(self) -> int:
        """The process itself."""
        return self.ring.recorder_pid

    def wait(self, seconds: float) -> None:
        """Sleep between two looks into the ring, or until the run is over."""
        self._has_ended.wait(seconds)

    def _await_recorder(self) -> str:
        self._has_ended.set()
        self._thread.join()
        return self._complaint

    def _record(self) -> None:
        self._complaint = record(self.ring, self)


def await_process(
    recorder: subprocess.Popen[bytes], ring: Ring, silent_s: float = RECORDER_PATIENCE_S
) -> str:
    """Let a recorder finish; return why it did not, be it killed here.

    It must not be silent for longer than `silent_s`, which is more for one that only starts, and
    get on with its rows within a minute, or read on in the file that it goes on with.
    """
    fault = ""
    silence, idleness = StandStill(lambda: ring.recorder_beats), StandStill(lambda: ring.tail)
    while recorder.poll() is None:
        if silence.lasts_s() > silent_s:
            fault = f"the recorder gave no sign of life for {silent_s:g} s"
        elif idleness.lasts_s() > _FINISH_PATIENCE_S:
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
