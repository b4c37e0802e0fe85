"""Signals that end a run, or a person's work on the rig: none cuts the end itself short."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

from pamctl.base.errors import ExitCode

STOP_SIGNALS = {
    signal.SIGINT: ExitCode.SIGINT,
    signal.SIGTERM: ExitCode.SIGTERM,
}
if hasattr(signal, "SIGHUP"):  # Windows closes a terminal in other ways
    STOP_SIGNALS[signal.SIGHUP] = ExitCode.SIGHUP


class SignalInterrupt(Exception):
    """A signal ended the work; `code` is the exit code that says so."""

    def __init__(self, number: int) -> None:
        """Keep the signal's number."""
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.code = 128 + number


class Interrupts:
    """Turns the first signal within `heed_signals` into `SignalInterrupt`; others wait.

    So the way out, on which the valve is made safe, always runs to its end. Ctrl-Z is ignored:
    a stopped process would hold the valve open.
    """

    def __init__(self) -> None:
        """Change nothing yet; the block does."""
        self._before: dict[int, object] = {}
        self._heeding = False
        self._pending: int | None = None

    def __enter__(self) -> Interrupts:
        """Take the signals over."""
        for number in STOP_SIGNALS:
            self._before[number] = signal.signal(number, self._note)
        self._before[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, signal.SIG_IGN)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Restore the handlers; raise for a signal that came outside `heed_signals`."""
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        if self._pending is not None and error is None:
            raise SignalInterrupt(self._pending)

    @contextmanager
    def heed_signals(self) -> Iterator[None]:
        """Let a signal end this block."""
        if self._pending is not None:
            raise SignalInterrupt(self._pending)
        self._heeding = True
        try:
            yield
        finally:
            self._heeding = False

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._pending is None:
            self._pending = number
        if self._heeding:
            self._heeding = False
            raise SignalInterrupt(number)


@contextmanager
def block_signals() -> Iterator[None]:
    """Block the signals that end a run; a process that is started within inherits the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def restore_signals() -> Iterator[None]:
    """Restore the handlers of the signals that end a run, unless an exception ends the block.

    The block reports the run as well: a further Ctrl-C, or a closed terminal, must not cut that
    short.
    """
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
