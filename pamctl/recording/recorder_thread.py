"""The recorder as a thread of this process, for a loop without a clock in the same process."""

from __future__ import annotations

import threading
from pathlib import Path

from pamctl.recording.drain import record_run
from pamctl.recording.ring import RecorderFlag, Ring


class RecordedRun:
    """A run whose log is written in a thread; as the owner of the recording it never leaves."""

    gone = False

    def __init__(self, name: str, ring: Ring) -> None:
        """Open the log of the ring; raise `LogError` or OSError where it cannot be written."""
        self.name, self.ring = name, ring
        self.log = Path(ring.meta.log_path)
        self._failure: Exception | None = None
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._record, name="recorder", daemon=True)
        self._thread.start()
        while not (ring.recorder_flags & RecorderFlag.READY or self._failure):
            self._is_over.wait(1e-3)
        if self._failure is not None:
            self.finish()

    @property
    def is_over(self) -> bool:
        """The loop has put its last row."""
        return self._is_over.is_set() or bool(self.ring.loop_done)

    def wait(self, seconds: float) -> None:
        """Sleep between two looks into the ring, or until the run is over."""
        self._is_over.wait(seconds)

    def finish(self) -> None:
        """Return when the log is whole; raise what kept it from being written."""
        self.ring.loop_done = 1
        self._is_over.set()
        self._thread.join()
        self.ring.unlink()
        self.ring.close()
        if self._failure is not None:
            raise self._failure

    def _record(self) -> None:
        try:
            record_run(self.ring, self)
        except Exception as error:
            self._failure = error
            self.ring.raise_flag(RecorderFlag.FAILED)
