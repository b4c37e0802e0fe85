"""One table for several methods: how often each was right, honest and wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path
from statistics import median
from typing import Any

from hidden.benchmark.failure import BenchmarkError
from hidden.benchmark.verdict_file import read_verdict
from hidden.examination.cases import Case
from hidden.examination.scoring import Result, detectable

UNANSWERED = {"verdict": "no_discrepancy", "effects": [], "ambiguous": [], "blind_spots": [],
              "gap": {}}  # fmt: skip

NAMED = ("single", "form", "pair", "triple", "closed_loop", "less", "odd")
NAMELESS = ("unknown", "left_out")


@dataclass(frozen=True)
class MethodScore:
    """The results of a method, and the cases it gave no verdict on."""

    name: str
    results: list[Result]
    unanswered: tuple[str, ...]


def score_method(name: str, cases: Mapping[str, Case], verdicts: Path) -> MethodScore:
    """Mark the verdicts of a folder; a case without one counts as if nothing had been found."""
    if not verdicts.is_dir():
        raise BenchmarkError(f"{verdicts}: is no folder of verdicts")
    results, unanswered = [], []
    for id, case in cases.items():
        path = verdicts / f"{id}.json"
        if path.exists():
            verdict = read_verdict(path)
            seconds = nan if verdict.cpu_s is None else verdict.cpu_s
            results.append(Result(case, verdict.as_document(), seconds))
        else:
            unanswered.append(id)
            results.append(Result(case, UNANSWERED, nan))
    if len(unanswered) == len(cases):
        raise BenchmarkError(f"{verdicts}: holds no verdict on any case of this truth")
    return MethodScore(name, results, tuple(unanswered))


def _count(good: Sequence[str], *groups: str) -> Callable[[Sequence[Result]], str]:
    def count(results: Sequence[Result]) -> str:
        asked = [r for r in results if r.case.group in groups and detectable(r.case) is not False]
        return f"{sum(r.mark in good for r in asked)} of {len(asked)}" if asked else "-"

    return count


def _count_effects(results: Sequence[Result], *marks: str) -> str:
    hidden = [r for r in results if r.case.effects and r.case.group != "bad"]
    return f"{sum(r.mark in marks for r in hidden)} of {len(hidden)}" if hidden else "-"


def _closed(results: Sequence[Result]) -> str:
    shares = [r.closed for r in results if r.case.group in NAMED and r.closed is not None]
    return f"{median(shares):.0%}" if shares else "-"


def _seconds(results: Sequence[Result]) -> str:
    known = [r.seconds for r in results if r.seconds == r.seconds]
    return f"{median(known):.1f} s" if known else "-"


_COLUMNS: dict[str, Callable[[Sequence[Result]], str]] = {
    "right name, one effect": _count(("right",), "single", "form", "closed_loop", "less", "odd"),
    "right names, two or three": _count(("right",), "pair", "triple"),
    "right, in a set or in part": _count(("right_set", "right_partial"), *NAMED),
    "no right name: says so": _count(("honest", "twin", "right_partial"), *NAMELESS),
    "nothing missing: says so": _count(("silent",), "null"),
    "missed": lambda results: _count_effects(results, "missed"),
    "hedged wrong name": lambda results: _count_effects(results, "misleading"),
    "confirmed wrong name": lambda results: _count_effects(results, "wrong"),
    "bad data refused": _count(("right",), "bad"),
    "gap closed, median, as stated": _closed,
    "processor time, median": _seconds,
}


def format_methods(scores: Sequence[MethodScore]) -> str:
    """Return the table in markdown: a row for each figure, a column for each method."""
    rows = [
        f"| | {' | '.join(score.name for score in scores)} |",
        "|---|" + "---|" * len(scores),
    ]
    for what, figure in _COLUMNS.items():
        values = [figure(score.results) for score in scores]
        if any(value != "-" for value in values):
            rows.append(f"| {what} | {' | '.join(values)} |")
    if any(score.unanswered for score in scores):
        counts = " | ".join(str(len(score.unanswered)) for score in scores)
        rows.append(f"| without a verdict | {counts} |")
    return "\n".join(rows)


def make_scores_document(scores: Sequence[MethodScore]) -> dict[str, Any]:
    """Return the marks by method, for programs."""
    return {
        score.name: {
            "marks": dict(Counter(result.mark for result in score.results)),
            "cases": [
                {
                    "case": result.case.id,
                    "repeat": result.case.repeat,
                    "mark": result.mark,
                    "verdict": result.answer.verdict,
                    "names": sorted(result.answer.names),
                }
                for result in score.results
            ],
            "unanswered": [*score.unanswered],
        }
        for score in scores
    }
