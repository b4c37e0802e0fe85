"""Search gains, or score given ones, in worker processes."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple

from pamctl.cluster.worker_processes import start_workers
from pamctl.new_file import NewFileError, write_files
from pamctl.settings.resolve import SECTIONS
from pamctl.tune.gains_file import Scores, format_gains_file, summarise_verdicts
from pamctl.tune.gains_search import BestGains, GainsSearch, Jury
from pamctl.tune.gains_trial import GainsTrial, GainsVerdict
from pamctl.tune.plant_ensemble import Member
from pamctl.tune.tune_text import describe_effort, report_scores
from pamctl.tune.tuning_task import TuningTask


class FoundGains(NamedTuple):
    """The result of a search."""

    best: BestGains
    scores: dict[str, Scores]
    """On plants the search has not seen, and on named ones; empty where interrupted."""
    took_s: float
    interrupted: bool
    """Stopped by Ctrl-C; the best gains so far are written all the same."""
    text: str
    """The gains file."""
    failure: NewFileError | None
    """Why the gains file could not be written; None where it was."""


def check_gains(
    task: TuningTask, jobs: int | None, cluster: str | None = None
) -> dict[str, Scores]:
    """Score the given gains on fresh plants, or on named ones."""
    with start_workers(jobs, cluster) as executor:
        return _score_gains(executor, task.checked, task)


def search_gains(
    task: TuningTask,
    jobs: int | None,
    generations: int,
    command: str,
    progress: Callable[[BestGains, float], None],
    cluster: str | None = None,
) -> FoundGains:
    """Search, score the best gains on plants the search has not seen, and write them.

    `command` goes into the file as its origin; `progress` is called after each generation with
    the seconds so far. The plants run in `jobs` processes of this machine, or on the Dask cluster
    at the address `cluster`. Raises `ClusterError`, and `KeyboardInterrupt` where
    that comes before the end of the first generation.
    """
    assert task.out is not None
    began_s = time.monotonic()
    interrupted = False
    scores: dict[str, Scores]
    with start_workers(jobs, cluster) as executor:
        search = GainsSearch(
            task.law,
            Jury(tuple(task.drawn), tuple(task.named)),
            task.seed,
            task.start,
            task.trial,
            task.elite_trial,
            task.compensate,
        )
        try:
            while search.generation < generations:
                progress(search.advance(executor), time.monotonic() - began_s)
        except KeyboardInterrupt:
            if not search.generation:
                raise
            interrupted = True
        best = search.best
        controller = SECTIONS["controller"].validate_python(best.gains)
        try:
            scores = _score_gains(executor, controller, task)
        except KeyboardInterrupt:  # a second one: the gains are written without scores
            interrupted, scores = True, {}
    effort = describe_effort(task, best)
    text = format_gains_file(best.gains, command, effort, report_scores(scores))
    failure = None
    try:
        write_files({task.out: text})
    except NewFileError as error:
        failure = error
    return FoundGains(best, scores, time.monotonic() - began_s, interrupted, text, failure)


def _score_gains(executor: Executor, controller: Any, task: TuningTask) -> dict[str, Scores]:
    """Return the scores on the fresh plants and on the named ones, where there are any."""
    verdict = partial(_judge_member, controller)
    members = [*task.fresh, *task.named]
    verdicts = list(executor.map(verdict, members, chunksize=max(1, len(members) // 50)))
    drawn = len(task.fresh)
    parts = {"fresh": slice(drawn), "named": slice(drawn, None)}
    return {
        which: summarise_verdicts(members[part], verdicts[part])
        for which, part in parts.items()
        if members[part]
    }


def _judge_member(controller: Any, member: Member) -> GainsVerdict:
    return GainsTrial("whole").verdict(controller, member)
