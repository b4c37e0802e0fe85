"""Work on other machines: an executor over a Dask cluster, or over this machine's own processes.

Dask (the package `distributed`) schedules, moves the data, and repeats what a lost worker had. Only
this file knows it. It is imported where an address is given, and nowhere else.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib import metadata
from typing import Any

from pamctl import __version__
from pamctl.exit_codes import ExitCode

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
            "pip install 'pamctl[cluster]', here and on every worker"
        ) from error
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ClusterError(
            f"--cluster {address}: no scheduler answers within {CONNECT_S:g} s; start one with "
            "`dask scheduler`, and give the address that it prints, such as tcp://HOST:8786"
        ) from error
    with client:
        _require_equal_workers(address, _ask_workers(address, client))
        yield client.get_executor(pure=False)


def _ask_workers(address: str, client: Any) -> dict[str, dict[str, str]]:
    try:
        found: dict[str, dict[str, str]] = client.run(describe_versions)
    except Exception as error:
        raise ClusterError(
            f"--cluster {address}: a worker cannot import pamctl ({error}); install the same "
            "version there as here"
        ) from error
    return found


def describe_versions() -> dict[str, str]:
    """Return the versions in this process of what computes a result."""
    numerical = {name: metadata.version(name) for name in NUMERICAL_PACKAGES}
    return {
        "pamctl": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        **numerical,
    }


def _require_equal_workers(address: str, workers: Mapping[str, Mapping[str, Any]]) -> None:
    if not workers:
        raise ClusterError(
            f"--cluster {address}: the scheduler has no workers; start one on each machine with "
            f"`dask worker {address} --nthreads 1 --nworkers auto`"
        )
    here = describe_versions()
    for worker, there in workers.items():
        for name, version in here.items():
            if there.get(name) != version:
                raise ClusterError(
                    f"--cluster {address}: {name} is {there.get(name)} on the worker {worker} and "
                    f"{version} here; install the same version on both"
                )
