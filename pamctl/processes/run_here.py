"""A run without a clock in this one process, for systems without rings in shared memory.

It is the same loop on the same simulated rig, and gives the same rows as `loop_main` with its
recorder. No valve depends on it: if this process dies, the log ends with the last whole chunk.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from pamctl.exit_codes import Ending, ExitCode
from pamctl.log.run_meta import RunMeta
from pamctl.log.writer import LogWriter
from pamctl.processes.backends import build_clock, build_rig, require_backend
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.program import CuedHelm
from pamctl.recording.drain import RowLogger
from pamctl.recording.journal import make_outcome_event
from pamctl.recording.log_journal import LogJournal
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import RunSettings
from pamctl.simulate.many_ticks import find_many_ticks


class _Interrupt:
    """Ends the run smoothly at the first Ctrl-C, and at once at the second."""

    def __init__(self) -> None:
        self._count = 0

    def note(self, number: int, frame: FrameType | None) -> None:
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
            ending = _run(journal, meta, settings)
        # The log keeps every tick until then.
        except Exception as error:
            ending = Ending(ExitCode.UNEXPECTED, f"{type(error).__name__}: {error}")
        journal.put_last_event(make_outcome_event(ending))
        journal.write_chunk()
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    return ending


def _run(journal: LogJournal, meta: RunMeta, settings: RunSettings) -> Ending:
    controller = settings.controller.model_dump(mode="json")
    begin = {"event": "timing_setup", "mode": "fast: no clock"}
    journal.put_event(0, meta.start_mono_ns, begin)
    journal.put_gains(0, meta.start_mono_ns, controller)
    setup, program = build_tick_setup(settings), build_program(settings)
    parts = build_rig(settings, build_clock(settings, may_spin=False))
    with _heed_interrupt() as interrupt:
        return ControlLoop(
            rig=parts.rig,
            clock=parts.clock,
            setup=setup,
            nominal_zero=nominal_zero_of(settings),
            program=program,
            journal=journal,
            supervisor=interrupt,
            truth=parts.truth,
            helm=CuedHelm(setup, controller, program, journal),
            many=find_many_ticks(setup, parts.rig, parts.clock),
        ).run()


@contextmanager
def _heed_interrupt() -> Iterator[_Interrupt]:
    interrupt = _Interrupt()
    before = signal.signal(signal.SIGINT, interrupt.note)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)
