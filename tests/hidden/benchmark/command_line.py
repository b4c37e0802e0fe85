"""`python -m pamctl.benchmark`: write the records, run a method, print the table.

python -m pamctl.benchmark write RECORDS --truth TRUTH.json [--suite sample|all]
    [--program brief|short|standard] [--seed N]
python -m pamctl.benchmark run RECORDS --method pamctl --out VERDICTS
    [--jobs N | --cluster ADDRESS]
python -m pamctl.benchmark score TRUTH.json VERDICTS [NAME=VERDICTS ...] [--json]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from hidden.benchmark.benchmark_suite import PROGRAMS, SUITES, Suite
from hidden.benchmark.methods_table import format_methods, make_scores_document, score_method
from hidden.benchmark.records_folder import list_ids, read_truth, write_records
from hidden.benchmark.run_method import MethodCrash, run_method
from pamctl.cluster.dask_cluster import connect_to_cluster


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; errors of a user leave with one line and their exit code."""
    options = _make_parser().parse_args(arguments)
    try:
        options.command(options)
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        code = getattr(error, "exit_code", None)
        if code is None:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(int(code))


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m pamctl.benchmark",
        description="A benchmark of methods that say what a model of a muscle rig lacks",
    )
    verbs = parser.add_subparsers(required=True, metavar="write|run|score")
    write = verbs.add_parser("write", help="write the records, and the truth apart")
    write.add_argument("records", type=Path, help="new folder")
    write.add_argument("--truth", type=Path, required=True, help="new file, outside the folder")
    write.add_argument("--suite", choices=SUITES, default="sample", help="which cases (sample)")
    write.add_argument("--program", choices=PROGRAMS, default="brief", help="excitation (brief)")
    write.add_argument("--seed", type=_parse_seed, default=0, help="0 or more (0)")
    write.set_defaults(command=_write)
    run = verbs.add_parser("run", help="run a method; stored verdicts are not run again")
    run.add_argument("records", type=Path)
    run.add_argument("--method", required=True, help="pamctl, MODULE:FUNCTION or FILE.py:FUNCTION")
    run.add_argument("--out", type=Path, required=True, help="folder for the verdicts")
    places = run.add_mutually_exclusive_group()
    places.add_argument("--jobs", type=_parse_jobs, default=1, help="processes of this machine (1)")
    places.add_argument("--cluster", metavar="ADDRESS", help="scheduler of a Dask cluster")
    run.set_defaults(command=_run)
    score = verbs.add_parser("score", help="mark the verdicts of one or more methods")
    score.add_argument("truth", type=Path)
    score.add_argument("verdicts", nargs="+", metavar="[NAME=]VERDICTS")
    score.add_argument("--json", action="store_true", help="print one JSON document")
    score.set_defaults(command=_score)
    return parser


def _parse_seed(text: str) -> int:
    if (seed := int(text)) < 0:
        raise argparse.ArgumentTypeError("must be 0 or more")
    return seed


def _parse_jobs(text: str) -> int:
    if (jobs := int(text)) < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return jobs


def _write(options: argparse.Namespace) -> None:
    suite = Suite(options.suite, options.program, options.seed)
    count = len(suite.list_cases())
    for done, _ in enumerate(write_records(suite, options.records, options.truth), 1):
        print(f"\r{done} of {count}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print(f"{options.records}: {count} cases; the truth: {options.truth}")


def _run(options: argparse.Namespace) -> None:
    began, crashed = time.monotonic(), []
    count = len(list_ids(options.records))
    with _start_workers(options) as executor:
        found = run_method(options.method, options.records, options.out, executor)
        for done, (id, verdict) in enumerate(found, 1):
            said = verdict.get("verdict", "CRASH")
            print(f"{done} {time.monotonic() - began:6.0f} s  {id}: {said}", file=sys.stderr)
            if "error" in verdict:
                crashed.append(id)
                print(verdict["error"], file=sys.stderr)
    stored = len(list(options.out.glob("*.json")))
    print(f"{options.out}: {stored} verdicts on {count} cases")
    if crashed:
        raise MethodCrash(f"--method {options.method}: raised on {', '.join(crashed)}")


@contextmanager
def _start_workers(options: argparse.Namespace) -> Iterator[Executor | None]:
    if options.cluster is not None:
        with connect_to_cluster(options.cluster) as executor:
            yield executor
    elif options.jobs == 1:
        yield None
    else:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(options.jobs, context) as executor:
            yield executor


def _score(options: argparse.Namespace) -> None:
    cases = read_truth(options.truth)
    scores = []
    for text in options.verdicts:
        name, given, path = text.rpartition("=")
        scores.append(score_method(name if given else Path(path).name, cases, Path(path)))
    if options.json:
        print(json.dumps(make_scores_document(scores), indent=2))
    else:
        print(format_methods(scores))
