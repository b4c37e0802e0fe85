"""Work on a Dask cluster of two real processes: the same results as here, and nothing is lost."""

import os
import signal
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from pamctl.base import worker_processes as cluster
from pamctl.base.worker_processes import ClusterError, connect_to_cluster, describe_versions
from pamctl.settings.resolve import resolve
from pamctl.tune import GainsSearch, Jury, Member

distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
pytestmark = pytest.mark.filterwarnings("default")  # Dask's own, at the end of a process


# Its page of the cluster is on any free port: on the usual one of Dask a second cluster warns.
@pytest.fixture(scope="module")
def two_workers() -> Iterator[Any]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs="ERROR"
    ) as local:
        yield local


@pytest.fixture(scope="module")
def address(two_workers: Any) -> str:
    return str(two_workers.scheduler_address)


def start_search() -> GainsSearch:
    return GainsSearch("pid", Jury((), (Member("paper", resolve().plant),)), seed=1)


@pytest.mark.long
def test_a_search_is_the_same_to_the_bit_though_a_worker_is_killed_in_its_middle(
    two_workers, address
):
    alone, shared = start_search(), start_search()
    alone.advance()
    with connect_to_cluster(address) as executor, ThreadPoolExecutor(1) as beside:
        going = beside.submit(shared.advance, executor)
        with distributed.Client(address, set_as_default=False) as watching:
            pids = watching.run(os.getpid)
            while not any(watching.processing().values()):
                assert not going.done(), "the search was over before a worker could be killed"
            os.kill(next(iter(pids.values())), signal.SIGKILL)
            going.result()
            assert pids != watching.run(os.getpid), "the worker was replaced"
    assert shared.best == alone.best
    assert np.array_equal(shared._costs, alone._costs)
    assert np.array_equal(shared._population, alone._population)


def test_a_worker_with_other_versions_is_refused(address, monkeypatch):
    ours = {**describe_versions(), "numpy": "1.0"}
    monkeypatch.setattr(cluster, "describe_versions", describe_versions_of(ours))
    with pytest.raises(ClusterError, match=r"numpy is .* on the worker .* and 1\.0 here"):
        connect_to_cluster(address).__enter__()


def describe_versions_of(ours: dict[str, str]) -> Any:
    """Return a function that answers `ours` here and the truth where it is sent to."""

    class Answer:
        def __call__(self) -> dict[str, str]:
            return ours

        def __reduce__(self) -> Any:
            return getattr, (cluster, "describe_versions")

    return Answer()


def test_a_cluster_without_workers_is_refused(monkeypatch):
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty,
        pytest.raises(ClusterError, match=r"no workers; start one .* `dask worker tcp://"),
    ):
        connect_to_cluster(empty.scheduler_address).__enter__()


def test_an_address_where_nobody_answers_is_refused(monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_S", 0.2)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        with pytest.raises(ClusterError, match=r"no scheduler answers within 0\.2 s"):
            connect_to_cluster(nobody).__enter__()
    with pytest.raises(ClusterError, match="no scheduler answers"):
        connect_to_cluster("nowhere at all").__enter__()
