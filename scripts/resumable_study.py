"""A study that takes hours: it can be stopped, and goes on where it stopped.

Results are lines of a JSONL file. Each has a `key`; a task whose key is stored is not run again.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, TypeVar

Task = TypeVar("Task")
Outcome = dict[str, Any]


def read_stored(path: Path) -> dict[str, Outcome]:
    """Return the stored results by key, without crashed tasks and lines that a kill cut short."""
    results: dict[str, Outcome] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            result = json.loads(line)
        except json.JSONDecodeError:
            continue
        if "error" not in result:
            results[result["key"]] = result
    return results


def run_resumable(
    tasks: Mapping[str, Task],
    examine: Callable[[Task], Outcome],
    path: Path,
    workers: int,
    describe: Callable[[Outcome], str] = lambda result: "",
) -> dict[str, Outcome]:
    """Run the tasks that are not stored yet and store each result; return all results by key.

    Progress goes to stderr; `describe` adds a few words on a result.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    results = read_stored(path)
    left = [task for key, task in tasks.items() if key not in results]
    began = time.perf_counter()
    with path.open("a") as file:
        for done, result in enumerate(_run_tasks(left, examine, workers), 1):
            file.write(json.dumps(result) + "\n")
            file.flush()
            results[result["key"]] = result
            spent_s = time.perf_counter() - began
            what = f"{result['key']}: {describe(result)}".rstrip(": ")
            print(f"{done}/{len(left)} {spent_s:6.0f} s  {what}", file=sys.stderr)
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
