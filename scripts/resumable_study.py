"""A study that takes hours: it can be stopped, and goes on where it stopped.

Results are lines of a JSONL file. Each has a `key`; a task whose key is stored is not run again.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

Task = TypeVar("Task")
Outcome = dict[str, Any]


def read_stored(path: Path | None) -> dict[str, Outcome]:
    """Return the stored results by key, without crashed tasks and lines that a kill cut short."""
    return {one["key"]: one for one in read_results(path) if "error" not in one}


def read_results(path: Path | None) -> Iterator[Outcome]:
    """Yield every stored result; a line that a kill cut short is left out."""
    for line in path.read_text().splitlines() if path is not None and path.exists() else ():
        with suppress(json.JSONDecodeError):
            yield json.loads(line)


def store_result(path: Path | None, result: Mapping[str, Any]) -> None:
    """Append a result to the file of a study that is kept."""
    if path is not None:
        with path.open("a") as file:
            file.write(json.dumps(result) + "\n")


def run_resumable(
    tasks: Mapping[str, Task],
    examine: Callable[[Task], Outcome],
    path: Path | None,
    workers: int,
    describe: Callable[[Outcome], str] = lambda result: "",
) -> dict[str, Outcome]:
    """Run the tasks that are not stored yet and store each result; return all results by key.

    Without a path nothing is kept. Progress goes to stderr; `describe` adds words on a result.
    """
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    results = read_stored(path)
    left = [task for key, task in tasks.items() if key not in results]
    began = time.perf_counter()
    for done, result in enumerate(_run_tasks(left, examine, workers), 1):
        store_result(path, result)
        results[result["key"]] = result
        spent_s = time.perf_counter() - began
        what = f"{result['key']}: {describe(result)}".rstrip(": ")
        print(f"{done}/{len(left)} {spent_s:6.0f} s  {what}", file=sys.stderr, flush=True)
    return results


def _run_tasks(
    tasks: list[Task], examine: Callable[[Task], Outcome], workers: int
) -> Iterator[Outcome]:
    if workers == 1:
        yield from map(examine, tasks)
        return
    with ProcessPoolExecutor(workers) as pool:
        for future in as_completed([pool.submit(examine, task) for task in tasks]):
            yield future.result()
