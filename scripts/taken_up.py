"""A study of hours that can be stopped, and is taken up where it was.

Results are lines of a JSONL file, each under its `key`; what is found there is not done again.
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


def stored(path: Path) -> dict[str, Outcome]:
    """Return the results so far; a line cut short by a kill, or of a crash, is done again."""
    found: dict[str, Outcome] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            result = json.loads(line)
        except json.JSONDecodeError:
            continue
        if "error" not in result:
            found[result["key"]] = result
    return found


def taken_up(
    tasks: Mapping[str, Task],
    examined: Callable[[Task], Outcome],
    path: Path,
    workers: int,
    told: Callable[[Outcome], str] = lambda result: "",
) -> dict[str, Outcome]:
    """Do the tasks that are not stored yet, store each as it is done; return all by key.

    Progress goes to stderr, with what `told` says of a result.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    found = stored(path)
    left = [task for key, task in tasks.items() if key not in found]
    began = time.perf_counter()
    with path.open("a") as file:
        for done, result in enumerate(_results(left, examined, workers), 1):
            file.write(json.dumps(result) + "\n")
            file.flush()
            found[result["key"]] = result
            spent_s = time.perf_counter() - began
            what = f"{result['key']}: {told(result)}".rstrip(": ")
            print(f"{done}/{len(left)} {spent_s:6.0f} s  {what}", file=sys.stderr)
    return found


def _results(
    tasks: list[Task], examined: Callable[[Task], Outcome], workers: int
) -> Iterator[Outcome]:
    if workers == 1:
        yield from map(examined, tasks)
        return
    with ProcessPoolExecutor(workers) as pool:
        for future in as_completed([pool.submit(examined, task) for task in tasks]):
            yield future.result()
