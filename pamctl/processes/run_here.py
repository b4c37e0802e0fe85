"""A run without a clock in this one process, for systems without rings in shared memory.

It is the same loop on the same simulated rig, and gives the same rows as `loop_main` with its
recorder. No valve depends on it: if this process dies, the log ends with the last whole chunk.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType

from pamctl.exit_codes import Ending, ExitCode
from pamctl.log.run_meta import RunMeta
from pamctl.log.writer import LogWriter
from pamctl.processes.backends import require_backend
from pamctl.processes.compose_loop import compose_loop
from pamctl.recording.drain import RowLogger
from pamctl.recording.journal import make_outcome_event
from pamctl.recording.log_journal import LogJournal
from pamctl.settings.resolve import RunSettings


class _Interrupt:
    """Ends the run smoothly at the first Ctrl-C, and at once at the second."""

    def __init__(self) -> None:
        self._count = 0

    def __enter__(self) -> _Interrupt:
        self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._count += 1

    def find_stop(self, tick: int) -> Ending | None:
        return Ending(ExitCode.SIGINT, "stopped by SIGINT") if self._count else None

    def wants_abort(self) -> bool:
        return self._count > 1


def run_here(
    meta: RunMeta,
    settings: RunSettings,
    tell: Callable[[Mapping[str, float]], None],
) -> Ending:
    """Run a simulation to its end, with its log at `meta.log_path`; return how it ended.

    Raise OSError if the log cannot be written.
    """
    require_backend(settings)
    with Path(meta.log_path).open("xb") as file:
        writer = LogWriter(file)
        journal = LogJournal(RowLogger(writer, meta), meta, tell)
        try:
            with _Interrupt() as interrupt:
                ending = compose_loop(settings, journal, interrupt).run()
        # The log keeps every tick until then.
        except Exception as error:
            ending = Ending(ExitCode.UNEXPECTED, f"{type(error).__name__}: {error}")
        journal.put_last_event(make_outcome_event(ending))
        journal.write_chunk()
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    return ending
