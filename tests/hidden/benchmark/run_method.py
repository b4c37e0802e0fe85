"""Run a method on every case of a folder of records; each verdict is stored as soon as it is there.

A method is a function of a `Task` that returns a verdict as a dictionary. It is named `pamctl`,
`MODULE:FUNCTION` or `FILE.py:FUNCTION`.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, as_completed
from pathlib import Path
from pickle import dumps, loads
from time import process_time
from typing import Any

from hidden.benchmark.failure import BenchmarkError
from hidden.benchmark.records_folder import Task, list_ids, read_task
from hidden.benchmark.verdict_file import VerdictFile
from pamctl.benchmark.rigs_folder import call_in_rigs
from pamctl.exit_codes import ExitCode

Verdict = dict[str, Any]
Method = Callable[[Task], Verdict]

SHIPPED = {"pamctl": "hidden.benchmark.by_pamctl:diagnose_task"}


def load_method(name: str) -> Method:
    """Return a method by its name; raise `BenchmarkError` where there is none."""
    where, _, function = SHIPPED.get(name, name).rpartition(":")
    try:
        if not where.endswith(".py"):
            return getattr(importlib.import_module(where), function)  # type: ignore[no-any-return]
        path = Path(where)
        if str(path.parent) not in sys.path:
            sys.path.insert(0, str(path.parent))  # the files beside it are its modules
        return getattr(importlib.import_module(path.stem), function)  # type: ignore[no-any-return]
    except (ImportError, AttributeError, ValueError) as error:
        raise BenchmarkError(
            f"--method {name}: {error}; give pamctl, MODULE:FUNCTION or FILE.py:FUNCTION"
        ) from None


def run_case(name: str, task: Task) -> Verdict:
    """Return the method's verdict on one case, with its processor time; or its `error`."""
    method = load_method(name)
    began = process_time()
    try:
        verdict = {"schema": 1, **method(task)}
        VerdictFile.model_validate(verdict)
    except Exception:
        return {"error": traceback.format_exc(limit=-4)}
    return {**verdict, "cpu_s": round(process_time() - began, 2)}


def run_packed_case(name: str, task: bytes) -> Verdict:
    """Run a pickled case: schedulers and workers unpack arguments before they know the rigs."""
    return run_case(name, loads(task))


def run_method(
    name: str, records: Path, verdicts: Path, executor: Executor | None
) -> Iterator[tuple[str, Verdict]]:
    """Run what has no verdict yet; yield (id, verdict), or (id, {"error": ...}) after a crash.

    The records travel with the task: a worker needs no common disk.
    """
    load_method(name)
    verdicts.mkdir(parents=True, exist_ok=True)
    left = [id for id in list_ids(records) if not (verdicts / f"{id}.json").exists()]
    for id, verdict in _run(name, records, left, executor):
        if "error" not in verdict:
            path = verdicts / f"{id}.json"
            draft = path.with_suffix(".part")
            draft.write_text(json.dumps(verdict, indent=1) + "\n", encoding="utf-8")
            draft.replace(path)
        yield id, verdict


def _run(
    name: str, records: Path, ids: list[str], executor: Executor | None
) -> Iterator[tuple[str, Verdict]]:
    if executor is None:
        yield from ((id, run_case(name, read_task(records, id))) for id in ids)
        return
    here, packed = "hidden.benchmark.run_method", (dumps(read_task(records, id)) for id in ids)
    going = {
        executor.submit(call_in_rigs, here, "run_packed_case", name, task): id
        for id, task in zip(ids, packed, strict=True)
    }
    for future in as_completed(going):
        yield going[future], future.result()


class MethodCrash(BenchmarkError):
    """A method raised on some cases; the other verdicts are stored."""

    exit_code = ExitCode.CHECK_FAILED
