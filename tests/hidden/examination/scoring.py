"""From a diagnosis's document to marks: right, honest, or wrong."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import mean, median
from typing import Any

from hidden.examination.cases import KIN, Case
from hidden.examination.oracle import HOPELESS, SURE
from hidden.examination.truth_values import relative_errors

ORACLE = Path(__file__).with_name("oracle.json")

SILENT = frozenset({"no_discrepancy", "miscalibrated"})

SAME_SETUP = {
    "encoder_scale": ("scale", "position_m"),
    "command_delay": ("skew", "valve_v"),
    "end_cap": ("plant_constant", "rest_length_m"),
}
"""Effects that are a fault of the set-up in other words, by the equations: either word is right."""
_LABELS = {"scale": "scale of ", "skew": "skew of ", "plant_constant": ""}


@dataclass(frozen=True)
class Answer:
    """What a document says, in sets."""

    verdict: str
    names: frozenset[str]
    ambiguous: tuple[frozenset[str], ...]
    blind: frozenset[str]
    by_setup: frozenset[str] = frozenset()
    """Effects that it names as a fault of the set-up, which it has mended."""

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Answer:
        """Read DESIGN section 7's document."""
        labels = {_LABELS[kind] + number: name for name, (kind, number) in SAME_SETUP.items()}
        found = {(f["kind"], f["number"]) for f in document.get("setup", ())}
        by_setup = frozenset(name for name, same in SAME_SETUP.items() if same in found)
        names = frozenset(effect["name"] for effect in document["effects"])
        is_silent = document["verdict"] in SILENT
        return cls(
            "named" if by_setup and is_silent else document["verdict"],
            names | by_setup,
            tuple(frozenset(labels.get(n, n) for n in group) for group in document["ambiguous"]),
            frozenset(spot["name"] for spot in document["blind_spots"]),
            by_setup,
        )

    def covers(self, name: str) -> bool:
        """Tell whether a name was said, alone or among those that cannot be told apart."""
        return name in self.names or any(name in group for group in self.ambiguous)

    @property
    def alarm(self) -> bool:
        """Tell whether it claims that physics is missing."""
        return self.verdict not in {*SILENT, "bad_data"}


@cache
def oracle_of(program: str) -> dict[str, dict[str, dict[str, float]]]:
    """Return what the truths alone say of a program's power, or nothing where it was not asked."""
    every: dict[str, dict[str, dict[str, dict[str, float]]]] = json.loads(ORACLE.read_text())
    return every.get(program, {})


def _seen(case: Case) -> dict[str, float]:
    """Return the oracle's row of a case with one hidden effect: {} where it cannot say."""
    if len(case.effects) != 1:
        return {}
    name, size = next(iter(case.effects.items()))
    multiple = size[0] if isinstance(size, tuple) else size
    rows = oracle_of(case.program).get(name, {})
    below = [row for key, row in rows.items() if float(key) <= multiple]
    return below[-1] if below else {}


def detectable(case: Case) -> bool | None:
    """Tell whether the effect must be found (True), cannot be (False), or lies between (None)."""
    if case.group == "blind":
        return False
    row = _seen(case)
    if not row:
        return True if case.effects else None
    if row["alone"] >= SURE:
        return True
    return False if row["alone"] <= HOPELESS else None


def twins(case: Case) -> frozenset[str]:
    """Return the rivals that this excitation cannot tell from the one hidden effect."""
    row = _seen(case)
    return frozenset(rival for rival, left in row.items() if rival != "alone" and left < SURE)


def kin(case: Case) -> set[str]:
    """Return names that are near what is hidden, without being it."""
    return set().union(*(KIN.get(name, set()) for name in case.effects))


def mark(case: Case, document: Mapping[str, Any]) -> str:
    """Return one word for how a case went.

    right, right_set (the true one in a stated set), right_partial, honest (admits that it cannot
    name), silent (rightly), missed, refused, twin (the one name that no data could tell from the
    true one, which was taken away), misleading (a wrong name, hedged), wrong (a wrong name,
    confirmed) or alarm (something named where nothing is missing).
    """
    answer = Answer.of(document)
    if case.group == "bad":
        return "right" if answer.verdict == "bad_data" else "missed"
    if answer.verdict == "bad_data":
        return "refused"
    if not case.effects or case.hidden_names <= {"moving_mass"}:
        return "alarm" if answer.alarm else "silent"
    if not answer.alarm:
        return "silent" if detectable(case) is False else "missed"
    if answer.verdict == "none_known" or (answer.verdict == "described" and not answer.names):
        return "honest"
    return _of_names(case, answer)


def _of_names(case: Case, answer: Answer) -> str:
    in_sets = frozenset[str]().union(*answer.ambiguous)
    # Taken out of the catalogue, it can still be found as a fault of the set-up.
    known = case.known_names | (case.hidden_names & {*SAME_SETUP} & (answer.by_setup | in_sets))
    if case.group == "left_out" and answer.names and answer.names <= twins(case):
        return "twin"
    if answer.verdict == "partial" and answer.names <= kin(case):
        return "right_partial"
    false = {
        name
        for name in answer.names - known
        if not any(name in group and group & known for group in answer.ambiguous)
    }
    covered = bool(known) and all(answer.covers(name) for name in known)
    if answer.verdict == "named":
        return "right" if answer.names == known else ("wrong" if false else "right_partial")
    if answer.verdict == "ambiguous":
        return "right_set" if covered and not false else "misleading"
    return "right_partial" if answer.names & known and not false else "misleading"


@dataclass(frozen=True)
class Result:
    """One examined case."""

    case: Case
    document: Mapping[str, Any]
    seconds: float

    @property
    def mark(self) -> str:
        """How it went."""
        return mark(self.case, self.document)

    @property
    def answer(self) -> Answer:
        """What was said."""
        return Answer.of(self.document)

    @property
    def closed(self) -> float | None:
        """Share of the way from recalibrated to floor that the extended model went."""
        shares = []
        for channel in self.document["gap"].values():
            above = channel["recalibrated"] - channel["floor"]
            if above > 0.5 * channel["floor"]:
                shares.append((channel["recalibrated"] - channel["extended"]) / above)
        return min(min(shares), 1.0) if shares else None


def by_group(results: Iterable[Result], *groups: str) -> list[Result]:
    """Return the results of some groups."""
    return [r for r in results if r.case.group in groups]


@dataclass(frozen=True)
class Figure:
    """One line of the table: a share (or another number), its target, and of how many."""

    what: str
    value: float
    target: str
    reached: bool
    of: int


def _share(results: Sequence[Result], good: Callable[[Result], bool]) -> float:
    return sum(map(good, results)) / max(len(results), 1)


def _at_least(what: str, value: float, target: float, of: int) -> Figure:
    return Figure(what, value, f">= {target:.0%}", value >= target, of)


def _at_most(what: str, value: float, target: float, of: int) -> Figure:
    return Figure(what, value, f"<= {target:.0%}", value <= target, of)


def figures(results: Sequence[Result]) -> list[Figure]:
    """Return the table of the issue's numbers, as far as there are cases for them."""
    lines = [*_naming(results), *_honesty(results), *_numbers(results)]
    return [line for line in lines if line.of > 0]


def _is_right(result: Result) -> bool:
    return result.mark == "right"


def _naming(results: Sequence[Result]) -> list[Figure]:
    """Return how often the right name was found where there is one."""
    singles = [r for r in by_group(results, "single") if detectable(r.case)]
    groups = {
        "right name, detectable and separable singles": (
            0.95, [r for r in singles if not twins(r.case)]),
        "exact set, pairs": (0.85, by_group(results, "pair")),
        "exact set, triple": (0.85, by_group(results, "triple")),
        "right name, other forms of the effect": (0.95, by_group(results, "form")),
        "right name, closed loop": (0.95, by_group(results, "closed_loop")),
        "right name, fewer sensors or no muscle": (0.95, by_group(results, "less")),
        "right name, pamctl's own experiment and loop": (0.95, by_group(results, "own")),
    }  # fmt: skip
    return [
        _at_least(what, _share(found, _is_right), target, len(found))
        for what, (target, found) in groups.items()
    ]


def _honesty(results: Sequence[Result]) -> list[Figure]:
    """Return how often something was said that is not so, or not known."""
    nulls = by_group(results, "null")
    hidden = [r for r in results if r.case.effects and r.case.group != "bad"]
    nameless = [r for r in by_group(results, "unknown", "left_out") if not r.case.known_names]
    twinned = [r for r in by_group(results, "single") if detectable(r.case) and twins(r.case)]
    blind = by_group(results, "blind")
    bad = by_group(results, "bad")
    at_most = {
        "false alarm, nothing hidden or parameters only": (0.02, "alarm", nulls),
        "confirmed wrong name, anywhere": (0.03, "wrong", hidden),
        "confirmed wrong name, where no name is right": (0.03, "wrong", nameless),
        "misleading partial or set": (0.10, "misleading", hidden),
    }
    lines = [
        _at_most(what, _share(found, lambda r, word=word: r.mark == word), target, len(found))
        for what, (target, word, found) in at_most.items()
    ]
    at_least: dict[str, tuple[float, Callable[[Result], bool], list[Result]]] = {
        "true one named or in the stated set, inseparable singles": (
            0.98, lambda r: all(map(r.answer.covers, r.case.effects)), twinned),
        "blind spot listed, and nothing named": (
            1.0, lambda r: not r.answer.alarm and r.case.hidden_names <= r.answer.blind, blind),
        "bad data refused": (1.0, _is_right, bad),
    }  # fmt: skip
    return lines + [
        _at_least(what, _share(found, good), target, len(found))
        for what, (target, good, found) in at_least.items()
    ]


def _numbers(results: Sequence[Result]) -> list[Figure]:
    """Return how much of the gap was closed, how true the numbers are, and the time it took."""
    lines = []
    for group, target in (("single", 0.95), ("pair", 0.90)):
        closed = [r.closed for r in by_group(results, group) if r.closed is not None]
        if closed:
            what = f"gap closed, {group}s (median)"
            lines.append(_at_least(what, median(closed), target, len(closed)))
    right = [r for r in by_group(results, "single") if _is_right(r)]
    for what, sizes in (("sizes 3 and 10", ("/3", "/10")), ("all sizes", ("/1", "/3", "/10"))):
        chosen = [r for r in right if r.case.id.endswith(sizes)]
        errors = [e for r in chosen for e in relative_errors(r.case, r.document)]
        if not errors:
            continue
        within = mean(abs(error) <= 0.05 for error, _ in errors)
        covered = mean(inside for _, inside in errors)
        lines.append(_at_least(f"parameters within 5 %, {what}", within, 0.95, len(errors)))
        lines.append(Figure(f"90 % intervals that hold the truth, {what}", covered, "85 to 95 %",
                            0.85 <= covered <= 0.95, len(errors)))  # fmt: skip
    seconds = median([r.seconds for r in results])
    lines.append(
        Figure("CPU seconds a case (median)", seconds, "<= 30", seconds <= 30, len(results))
    )
    return lines


def table(lines: Sequence[Figure]) -> str:
    """Return the figures in markdown."""
    rows = ["| | measured | asked | cases |", "|---|---|---|---|"]
    for line in lines:
        value = f"{line.value:.1f}" if line.what.startswith("CPU seconds") else f"{line.value:.1%}"
        rows.append(f"| {line.what} | {value}{'' if line.reached else ' **!**'} "
                    f"| {line.target} | {line.of} |")  # fmt: skip
    return "\n".join(rows)


def confusion(results: Sequence[Result]) -> str:
    """Return hidden against said, in markdown: one row an effect, one entry a repeat and size."""
    rows = ["| hidden | said (times) |", "|---|---|"]
    singles = by_group(results, "single", "form")
    for name in sorted({next(iter(r.case.effects)) for r in singles}):
        said = Counter(
            _said(r.answer) for r in singles if next(iter(r.case.effects)) == name
        )  # fmt: skip
        entries = (f"{what} {times}" for what, times in said.most_common())
        rows.append(f"| {name} | {', '.join(entries)} |")
    return "\n".join(rows)


def _said(answer: Answer) -> str:
    names = "+".join(sorted(answer.names))
    if answer.verdict == "named":
        return f"**{names}**"
    if answer.verdict == "ambiguous":
        return " or ".join("/".join(sorted(group)) for group in answer.ambiguous)
    return f"{answer.verdict} {names}".strip()
