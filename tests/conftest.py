"""What all tests have in common: a place in shared memory of their own, and patience."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("patient", deadline=None)  # the machine that runs them may be busy
settings.load_profile("patient")

# A run finishes the logs of all runs that died before it: another worker's or user's tests must
# not find ours. Before anything of pamctl is imported, and for every process that a test starts.
_OURS = Path("/dev/shm", f"pamctl-tests-{os.getpid()}")
os.environ["PAMCTL_SHARED_MEMORY"] = str(_OURS)


def pytest_sessionstart(session: pytest.Session) -> None:
    _OURS.mkdir()
    # A shell lets what it starts in the background ignore Ctrl-C, and with it all that we start.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_sessionfinish(session: pytest.Session) -> None:
    shutil.rmtree(_OURS, ignore_errors=True)
