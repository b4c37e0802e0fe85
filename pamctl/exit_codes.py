"""How a run ended, and the exit code for it."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


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
