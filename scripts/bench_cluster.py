"""Measure what `--cluster` gains: cases of the benchmark in one process, then on two workers.

    python scripts/bench_cluster.py RECORDS [--cases 8] [--workers 2] [--kill]

RECORDS comes from `python -m pamctl.benchmark write`. The cluster is local: real processes of one
thread each. Elapsed seconds depend on what else the machine does; processor seconds hardly do. With
`--kill` the first worker is killed while all are busy. The verdicts must be equal, every time.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any


def take_cases(records: Path, count: int, folder: Path) -> Path:
    """Copy the first cases of a folder of records into a new one."""
    taken = folder / "records"
    taken.mkdir()
    about = json.loads((records / "benchmark.json").read_text())
    about["cases"] = about["cases"][:count]
    (taken / "benchmark.json").write_text(json.dumps(about))
    for id in about["cases"]:
        shutil.copytree(records / id, taken / id)
    return taken


def start_run(records: Path, verdicts: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "pamctl.benchmark", "run", str(records), "--method", "pamctl"]
    command += ["--out", str(verdicts), *options]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL)


def measure_alone(records: Path, verdicts: Path) -> tuple[float, float]:
    """Return elapsed and processor seconds of one process."""
    began, before = time.monotonic(), _read_children_s()
    _finish(start_run(records, verdicts))
    return time.monotonic() - began, _read_children_s() - before


def measure_cluster(records: Path, verdicts: Path, workers: int, kill: bool) -> tuple[float, float]:
    """Return elapsed and processor seconds on workers, theirs and the client's.

    What a killed worker had spent is not among them. The start of the workers is not either: a
    cluster stands by.
    """
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None, silence_logs="ERROR"
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        first = client.run(time.process_time)
        began, before = time.monotonic(), _read_children_s()
        run = start_run(records, verdicts, "--cluster", cluster.scheduler_address)
        if kill:
            _kill_one(client, run)
        _finish(run)
        elapsed_s = time.monotonic() - began
        spent = client.run(time.process_time)
        workers_s = sum(spent_s - first.get(worker, 0.0) for worker, spent_s in spent.items())
        return elapsed_s, _read_children_s() - before + workers_s


def _kill_one(client: Any, run: subprocess.Popen[bytes]) -> None:
    """Kill a worker while every worker has a task."""
    pids = client.run(os.getpid)
    while not all(client.processing().values()):
        if run.poll() is not None:
            sys.exit("the run was over before a worker could be killed")
        time.sleep(0.1)
    time.sleep(1.0)
    os.kill(next(iter(pids.values())), signal.SIGKILL)


def _finish(run: subprocess.Popen[bytes]) -> None:
    if code := run.wait():
        sys.exit(f"the benchmark left with {code}")


def _read_children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def read_verdicts(folder: Path) -> dict[str, Any]:
    """Return the verdicts of a folder without the seconds that they took."""
    read = {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}
    return {id: {k: v for k, v in one.items() if k != "cpu_s"} for id, one in read.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("records", type=Path)
    parser.add_argument("--cases", type=int, default=8)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kill", action="store_true", help="once more, with a worker killed")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        records = take_cases(options.records, options.cases, folder)
        alone_s, alone_cpu_s = measure_alone(records, folder / "alone")
        expected = read_verdicts(folder / "alone")
        _print("one process", alone_s, alone_cpu_s)
        for kill in (False, True) if options.kill else (False,):
            place = folder / f"cluster-{kill}"
            elapsed_s, cpu_s = measure_cluster(records, place, options.workers, kill)
            _print("a worker killed" if kill else f"{options.workers} workers", elapsed_s, cpu_s)
            same = read_verdicts(place) == expected
            print(f"  {alone_s / elapsed_s:.2f} times as fast, ", end="")
            print(f"{cpu_s / alone_cpu_s:.2f} times the processor, ", end="")
            print(f"{len(expected)} verdicts {'equal' if same else 'NOT EQUAL'}", flush=True)


def _print(what: str, elapsed_s: float, cpu_s: float) -> None:
    load = os.getloadavg()[0]
    print(f"{what}: {elapsed_s:.1f} s, processor {cpu_s:.1f} s, load {load:.1f}", flush=True)


if __name__ == "__main__":
    main()
