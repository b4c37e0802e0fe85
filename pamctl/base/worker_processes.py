"""Worker processes for long work: of this machine, or of a Dask cluster.

Dask (the package `distributed`) schedules, moves the data, and repeats what a lost worker had. It
is imported where an address is given, and nowhere else.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from importlib import metadata
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from hal.child import without_working_directory
from pamctl import __version__
from pamctl.base.errors import ExitCode


class _Worker(SpawnProcess):
    """A worker process, started when there is work for it."""

    def start(self) -> None:
        with without_working_directory():
            super().start()


class _Spawn(SpawnContext):
    """The way to start workers that finds the same modules as this process."""

    Process = _Worker


@contextmanager
def start_workers(jobs: int | None, cluster: str | None = None) -> Iterator[Executor]:
    """Yield an executor with so many processes (None: one a processor), or over a cluster.

    What has not begun when the block is left, is not begun. Raises `ClusterError`.
    """
    if cluster is not None:
        with connect_to_cluster(cluster) as on_cluster:
            yield on_cluster
        return
    # Not forked: a fork of a process with numpy's threads may hang.
    with without_working_directory():  # the first lock starts a process
        executor = ProcessPoolExecutor(jobs or os.cpu_count(), _Spawn(), initializer=_begin_work)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def _begin_work() -> None:
    """Leave Ctrl-C to the parent process, and end when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A worker holds both ends of the pipe that it waits on: it would wait there without end.
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


CONNECT_S = 10.0
NUMERICAL_PACKAGES = ("numpy", "scipy", "pydantic")
"""Other versions of these may round differently, or read other settings."""


class ClusterError(Exception):
    """A cluster cannot be used. The message says why, and what to do."""

    exit_code = ExitCode.UNAVAILABLE


@contextmanager
def connect_to_cluster(address: str) -> Iterator[Executor]:
    """Yield an executor whose work runs on the workers of a Dask scheduler.

    It has `submit` and `map` of the standard library's executors. A task whose worker is lost runs
    again on another. Workers with other versions than here are refused: on processors of one kind
    the results are those of this process to the bit. Raises `ClusterError`.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise ClusterError(
            f"--cluster {address}: needs the package distributed; install it with "
            "pip install distributed, here and on every worker"
        ) from error
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ClusterError(
            f"--cluster {address}: no scheduler answers within {CONNECT_S:g} s; start one with "
            "`dask scheduler`, and give the address that it prints, such as tcp://HOST:8786"
        ) from error
    with client:
        _require_equal_workers(address, client)
        yield client.get_executor(pure=False)


def describe_versions() -> dict[str, str]:
    """Return the versions in this process of what computes a result."""
    numerical = {name: metadata.version(name) for name in NUMERICAL_PACKAGES}
    return {
        "pamctl": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        **numerical,
    }


def _require_equal_workers(address: str, client: Any) -> None:
    try:
        workers: dict[str, dict[str, str]] = client.run(describe_versions)
    except Exception as error:
        raise ClusterError(
            f"--cluster {address}: a worker cannot import pamctl ({error}); install the same "
            "version there as here"
        ) from error
    if not workers:
        raise ClusterError(
            f"--cluster {address}: the scheduler has no workers; start one on each machine with "
            f"`dask worker {address} --nthreads 1 --nworkers auto`"
        )
    for worker, there in workers.items():
        for name, version in describe_versions().items():
            if there.get(name) != version:
                raise ClusterError(
                    f"--cluster {address}: {name} is {there.get(name)} on the worker {worker} and "
                    f"{version} here; install the same version on both"
                )
