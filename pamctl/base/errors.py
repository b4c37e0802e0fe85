"""How a run ended, and the exit code for it; and settings that cannot be used."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import NamedTuple

from hal.problem import Problem as Problem


class ExitCode(IntEnum):
    """Exit codes of every command; they do not change between versions."""

    OK = 0
    """Complete."""
    UNEXPECTED = 1
    """Something unexpected: a process died, the disk is full."""
    USAGE = 2
    """Wrong options."""
    CHECK_FAILED = 3
    """A check failed, data were lost, or the daemon refused."""
    SAFETY_TRIP = 4
    """A safety trip ended the run."""
    OVERRUNS = 5
    """More ticks were missed than the limit allows."""
    BAD_DATA = 65
    """Bad data: a log or a measurement that cannot be used."""
    UNAVAILABLE = 69
    """Device, driver, daemon or required scheduling is not available."""
    BAD_CONFIG = 78
    """Bad configuration."""
    SIGHUP = 129
    """Stopped by SIGHUP: its terminal was closed."""
    SIGINT = 130
    """Stopped by SIGINT (Ctrl-C)."""
    SIGTERM = 143
    """Stopped by SIGTERM."""


EMERGENCY_STOP = "emergency stop"
"""Begins the reason of a run that someone stopped at once; its code is that of a safety trip."""
LOG_DISK_FULL = "the log's disk is full"
"""The reason of a run that stopped because its log cannot grow; its code is `UNEXPECTED`."""


class Ending(NamedTuple):
    """Why the loop ended."""

    code: ExitCode
    reason: str


@contextmanager
def end_on_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, by a `KeyboardInterrupt`."""

    def end(number: int, frame: object) -> None:
        raise KeyboardInterrupt(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP")]  # Windows lacks one
    before = {number: signal.signal(number, end) for number in numbers if number}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def name_interrupt(stop: KeyboardInterrupt) -> ExitCode:
    """Return the exit code of what Ctrl-C or `end_on_signals` ended."""
    first = stop.__cause__ or stop
    return ExitCode(128 + first.args[0]) if first.args else ExitCode.SIGINT


class ConfigError(Exception):
    """Settings that cannot be used, with all their problems."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        """Keep the problems; the message has one line each."""
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))

    @property
    def exit_code(self) -> ExitCode:
        """2 where only options are wrong, 78 where a file or a setting is."""
        places = [problem.where for problem in self.problems]
        options_only = all(at.startswith("--") and not at.startswith("--set") for at in places)
        return ExitCode.USAGE if options_only else ExitCode.BAD_CONFIG
