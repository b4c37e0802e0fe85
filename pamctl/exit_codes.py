"""How a run ended, and the exit code for it."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class ExitCode(IntEnum):
    """Exit codes of every command; they do not change between versions."""

    OK = 0
    UNEXPECTED = 1
    USAGE = 2
    CHECK_FAILED = 3
    SAFETY_TRIP = 4
    OVERRUNS = 5
    BAD_DATA = 65
    UNAVAILABLE = 69
    BAD_CONFIG = 78
    SIGINT = 130
    SIGTERM = 143


class Ending(NamedTuple):
    """Why the loop ended."""

    code: ExitCode
    reason: str
