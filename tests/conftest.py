"""Shared by all tests: shared memory, machine code of the laws, the order of the files."""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.testing
from hypothesis import settings

# Hundreds of processes are started: not one of them should compile its sources anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# The machine may be busy, and hundreds of examples cost minutes.
settings.register_profile("patient", deadline=None, max_examples=40)
settings.load_profile("patient")

# A run finishes the logs of all earlier runs that died. Tests of another worker or user must not
# find ours. Set before pamctl is imported; every process that a test starts inherits it.
_OURS = Path("/dev/shm", f"pamctl-tests-{os.getpid()}")
os.environ["PAMCTL_SHARED_MEMORY"] = str(_OURS)

from pamctl.realtime.scheduling import keep_single_threaded  # noqa: E402


def _load_algebra_single_threaded() -> None:
    """Load the linear algebra of numpy and SciPy with one thread, as `pamctl` does.

    Processes that a test starts do not inherit this: they set it themselves, and tests check it.
    """
    ours = dict(os.environ)
    keep_single_threaded()
    importlib.import_module("scipy.linalg")
    os.environ.clear()
    os.environ.update(ours)


_load_algebra_single_threaded()

# Else typer builds all verbs anew for each call that a test makes: a tenth of a second.
typer.testing._get_command = cache(typer.testing._get_command)

_DURATIONS = "pamctl/seconds_by_test"
"""Where pytest's cache keeps how long each test took when it last ran."""
_seconds: dict[str, float] = {}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run the longest files first: a long file that came last would leave other workers idle.

    A file that never ran here counts by its size; one that starts processes counts for more.
    """
    cache = getattr(config, "cache", None)  # none with `-p no:cacheprovider`
    known: dict[str, float] = cache.get(_DURATIONS, {}) if cache else {}
    seconds: dict[Path, float] = {}
    for item in items:
        seconds[item.path] = seconds.get(item.path, 0.0) + known.get(item.nodeid, 0.0)
    size = {path: _weigh_file(path) for path in seconds}
    measured = [path for path in seconds if seconds[path] > 0.0]
    bytes_per_s = sum(map(size.get, measured)) / sum(map(seconds.get, measured)) if measured else 1
    cost = {path: seconds[path] or size[path] / bytes_per_s for path in seconds}
    items.sort(key=lambda item: (-cost[item.path], str(item.path)))


def _weigh_file(path: Path) -> int:
    source = path.read_bytes()
    return len(source) * (4 if b"import subprocess" in source or b"import daemon" in source else 1)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Run one file more than there are CPUs: runs in real time mostly wait."""
    return len(os.sched_getaffinity(0)) + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Share out files, but keep those together that share one investigation of a rig."""
    from xdist.scheduler import LoadFileScheduling

    class FileScheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            here = "tests/session/on_rig"
            return here if file.startswith(f"{here}/") else file

    return FileScheduling(config, log) if config.getoption("dist") == "loadfile" else None


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration


def pytest_sessionstart(session: pytest.Session) -> None:
    shutil.rmtree(_OURS, ignore_errors=True)  # of a killed run, whose number came again
    _OURS.mkdir()
    # A shell makes its background jobs ignore Ctrl-C, and our child processes would inherit that.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:  # under nohup
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_sessionfinish(session: pytest.Session) -> None:
    cache = getattr(session.config, "cache", None)
    if cache and not hasattr(session.config, "workerinput"):  # the controller hears of all tests
        cache.set(_DURATIONS, {**cache.get(_DURATIONS, {}), **_seconds})
    shutil.rmtree(_OURS, ignore_errors=True)
