"""What all tests have in common: a place in shared memory of their own, and patience."""

from __future__ import annotations

import importlib
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

from pamctl.realtime.scheduling import keep_single_threaded  # noqa: E402


def _algebra_in_one_thread() -> None:
    """Load numpy's algebra and SciPy's as `pamctl` does: its threads have no CPU to spare here.

    What a test starts does not inherit it: that sees to it itself, and is tested for it.
    """
    ours = dict(os.environ)
    keep_single_threaded()
    importlib.import_module("scipy.linalg")
    os.environ.clear()
    os.environ.update(ours)


_algebra_in_one_thread()

LONGEST_FIRST = (
    "test_fault_processes.py", "test_tune.py", "test_daemon_deaths.py", "test_run.py",
    "test_nidaq.py", "test_diagnose.py", "test_guardian.py", "test_daemon.py",
    "test_plant_convergence.py", "test_truth.py", "test_live.py", "test_recorder_faults.py",
    "test_effects_physics.py", "test_examination.py", "test_calibrate.py", "test_report.py",
    "test_diagnosis_page.py", "test_log.py", "test_watch.py", "test_log_fuzz.py",
    "test_compiled.py", "test_doctor.py", "test_safety.py", "test_reproduce.py",
    "test_offline_verbs.py", "test_readonly.py", "test_watch_web.py", "test_diagnose_example.py",
    "test_rig.py", "test_regimes.py", "test_loop.py", "test_faults.py", "test_laws.py",
    "test_settings.py", "test_yamlfile.py", "test_log_import.py", "test_daemon_clients.py",
    "test_correction.py", "test_log_check.py", "test_repeatability.py", "test_two_readings.py",
    "test_service.py", "test_intervals.py", "test_plant.py", "test_closed_loop.py",
    "test_replay.py", "test_rig_contract.py", "test_excitation.py", "test_failure_documents.py",
    "test_scheduling.py", "test_gains.py",
)  # fmt: skip
"""Files that take long: one that came last would leave all other workers idle."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    rank = {name: place for place, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


def pytest_sessionstart(session: pytest.Session) -> None:
    _OURS.mkdir()
    # A shell lets what it starts in the background ignore Ctrl-C, and with it all that we start.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:  # under nohup
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_sessionfinish(session: pytest.Session) -> None:
    shutil.rmtree(_OURS, ignore_errors=True)
