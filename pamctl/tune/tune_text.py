"""What a search found: for the gains file, for the terminal, and as one document."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pamctl.tune.gains_file import Scores
from pamctl.tune.gains_search import QUANTILE, BestGains
from pamctl.tune.tuning_task import TuningTask

_SHOWN_FAILURES = 8
_ERROR_NAMES = {"max": "largest error", "RMS": "RMS error", "steady": "steady error"}
_PLANT_SET_NAMES = {"fresh": "fresh plants", "named": "named plants"}


def describe_effort(task: TuningTask, best: BestGains) -> str:
    """Return how the gains were found, for the gains file."""
    drawn = f"the quantile {QUANTILE:g} of {len(task.drawn)} drawn plants" if task.drawn else ""
    named = " and ".join(member.name for member in task.named)
    judges = ", and for ".join(filter(None, [drawn, named]))
    runs = f"{best.evaluations} runs of {task.trial.duration_s:g} s"
    if task.elite_trial is not None:
        runs += f" and {best.longer_evaluations} of {task.elite_trial.duration_s:g} s"
    return (
        f"Differential evolution, {best.generation} generations, {runs}, for {judges}; "
        f"cost {best.cost:.3f}."
    )


def report_scores(found: Mapping[str, Scores]) -> str:
    """Return how good the gains are, for the gains file."""
    if not found:
        return "Not scored: interrupted."
    said = [
        f"on {one.plants} {_PLANT_SET_NAMES[which]} {one.inside} inside Table IV "
        f"({100 * one.share:.1f} %), "
        f"score median {one.median:.2f}, 95 % {one.p95:.2f}, worst {one.worst:.2f}"
        for which, one in found.items()
    ]
    return f"Both experiments in full: {'; '.join(said)}."


def format_scores(law: str, found: Mapping[str, Scores]) -> str:
    """Return how good the gains are, for the terminal."""
    return "\n".join(
        _format_one_score(f"{law}, {_PLANT_SET_NAMES[which]}", one) for which, one in found.items()
    )


def _format_one_score(title: str, found: Scores) -> str:
    lines = [
        f"{title}: {found.inside} of {found.plants} inside every bound of Table IV "
        f"({100 * found.share:.1f} %)",
        f"largest error over its bound: median {found.median:.2f}, 95 % {found.p95:.2f}, "
        f"worst {found.worst:.2f}",
    ]
    for name, why, worst in found.failures[:_SHOWN_FAILURES]:
        lines.append(f"  outside: plant {name}: {_describe_failure(why, worst)}")
    if len(found.failures) > _SHOWN_FAILURES:
        lines.append(f"  and {len(found.failures) - _SHOWN_FAILURES} more")
    return "\n".join(lines)


def _describe_failure(why: str, worst: float) -> str:
    """Say which error is too large; `why` is such as "max 1", or the name of an ending."""
    kind, _, experiment = why.rpartition(" ")
    if kind not in _ERROR_NAMES:
        return why
    return f"{_ERROR_NAMES[kind]} of experiment {experiment} is {worst:.2f} times the paper's"


def make_scores_document(found: Mapping[str, Scores]) -> dict[str, Any] | None:
    """Return the scores as one document; None where there are none."""
    return {which: _score_fields(one) for which, one in found.items()} or None


def _score_fields(found: Scores) -> dict[str, Any]:
    failures = [{"plant": n, "why": why, "worst": worst} for n, why, worst in found.failures]
    return {**found._asdict(), "share": found.share, "failures": failures}
