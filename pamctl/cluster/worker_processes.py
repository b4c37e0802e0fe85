"""Worker processes for long work: of this machine, or of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import multiprocessing.context
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager

from hal.child import without_working_directory
from pamctl.cluster.dask_cluster import connect_to_cluster


class _Worker(multiprocessing.context.SpawnProcess):
    """A worker process, started when there is work for it."""

    def start(self) -> None:
        with without_working_directory():
            super().start()


class _Spawn(multiprocessing.context.SpawnContext):
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
