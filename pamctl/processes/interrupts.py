"""Signals while a person works on the rig: the first ends the work, none cuts its end short."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

_HEEDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


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
        for number in _HEEDED:
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
