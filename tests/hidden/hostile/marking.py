"""From a diagnosis's document to a mark: the right cause, honest, or wrong."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hidden.examination.scoring import SILENT
from hidden.hostile.causes import PLACES, SetupCause
from hidden.hostile.situations import HostileCase
from hidden.hostile.trial import TRUTH_NAMES, rig_of, start_plant
from hidden.hostile.visible import is_hopeless

RIGHT = ("right", "silent")
HONEST = ("honest", "set", "twin", "refused")
"""Nothing false is said: it admits, states a set that holds the truth, or an equal equation."""

NOISE_WORDS = {
    "filtered": r"filter|zero.?phase|non.?causal|smooth",
    "hum": r"\bhum|hum\b|mains|line",
    "outliers": r"outlier|spike",
    "dropouts": r"drop.?out|outlier|spike",
    "jitter": r"jitter|stamp",
    "wander": r"wander|slow|drift|1/f",
    "flow": r"flow|moving|motion|speed|grows",
    "coarse": r"quant|coarse|bits|step",
}

FITTED = frozenset({
    "valve_gain_m2_per_v", "tank_pressure_pa", "damping_n_s_per_m", "stiffness_n_per_m",
    "kinetic_friction_per_m", "braid_length_m",
})  # fmt: skip
"""Numbers that are really off by a few per cent in every rig: to find them is never false."""

TAKEN_BACK = 0.35
"""A recalibrated number says that the typed one was wrong if it leaves this share of the error."""


@dataclass(frozen=True)
class Said:
    """What a document says, in sets."""

    verdict: str
    names: frozenset[str]
    sets: tuple[frozenset[str], ...]
    findings: tuple[Mapping[str, Any], ...]
    noise: str
    recalibrated: Mapping[str, float]
    reason: str

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Said:
        """Read a document; keys that are newer than it are empty."""
        return cls(
            document["verdict"],
            frozenset(effect["name"] for effect in document["effects"]),
            tuple(frozenset(map(str, group)) for group in document["ambiguous"]),
            tuple(document.get("setup") or ()),
            " ".join(_faults_of(document.get("noise") or {})),
            {name: float(n["value"]) for name, n in document.get("recalibrated", {}).items()},
            f"{document.get('reason') or ''} {document.get('sentence') or ''}",
        )

    @property
    def confident(self) -> bool:
        """Tell whether its names are said as names, not as one of a set."""
        return self.verdict in ("named", "partial")


def _faults_of(noise: Mapping[str, Any]) -> Iterable[str]:
    for channel, about in noise.items():
        if not isinstance(about, Mapping):
            continue
        if about.get("source") == "unknown":
            yield f"{channel}: unknown"
        for fault in about.get("faults") or ():
            if isinstance(fault, Mapping):
                fault = " ".join(str(fault.get(k, "")) for k in ("kind", "name", "fault"))
            yield f"{channel}: {fault}"


def mark(case: HostileCase, document: Mapping[str, Any]) -> str:
    """Return one word for how a case went.

    right; silent (rightly); honest (admits that it cannot name); set (of which one is true); twin
    (the same equation under another name, alone); refused; missed (silent where a cause was to be
    said); misled (a set without the truth); kin (a neighbour of what no catalogue has, as a
    partial); wrong (a confident name or a set-up finding that is not so).
    """
    answer, said = case.answer, Said.of(document)
    if said.verdict == "bad_data":
        refused = any(re.search(word, said.reason, re.IGNORECASE) for word in answer.refusal)
        found = bool(answer.setup) and all(_is_found(case, c, said) for c in answer.setup)
        return "right" if refused or found else "refused"
    covered = _covers(case, said)
    if false_findings(case, said):
        return "wrong"
    false = false_names(case, said, covered)
    if false and said.confident:
        return "kin" if said.verdict == "partial" and false <= answer.near else "wrong"
    if covered:
        return "right"
    if said.verdict in SILENT and not said.names:
        return "silent" if answer.silent or is_hopeless(case) else "missed"
    if said.verdict == "ambiguous":
        return _of_sets(case, said)
    if said.confident and said.names & answer.equal:
        return "twin"
    return "honest"


def _covers(case: HostileCase, said: Said) -> bool:
    """Tell whether every cause that is to be said is said."""
    answer = case.answer
    if answer.unknown:
        return said.verdict in ("none_known", "described")
    if not (answer.effects or answer.setup or answer.noise):
        return False
    return (
        (said.confident or said.verdict == "ambiguous" or not answer.effects)
        and answer.effects <= said.names
        and all(_is_found(case, cause, said) or _is_equal(case, said) for cause in answer.setup)
        and all(_is_noise_said(word, said) for word in answer.noise)
    )


def _is_equal(case: HostileCase, said: Said) -> bool:
    """Tell whether an equal name is said together with what it cannot be told from."""
    truths = {cause.number for cause in case.answer.setup} | {c.kind for c in case.answer.setup}
    return any(
        any(_touches(entry, truths) for entry in group) and group & case.answer.equal
        for group in said.sets
    )


def _touches(entry: str, words: Iterable[str]) -> bool:
    return any(word and word in entry for word in words)


def _is_noise_said(word: str, said: Said) -> bool:
    if word == "filtered" and "unknown" in said.noise:
        return True
    return _is_fault_said(word, said)


def _is_found(case: HostileCase, cause: SetupCause, said: Said) -> bool:
    """Tell whether a finding states the cause, as itself or among what it cannot be told from."""
    if any(_matches(cause, finding) for finding in said.findings):
        return True
    value = said.recalibrated.get(cause.number)
    if cause.kind != "plant_constant" or value is None:
        return False
    true = float(getattr(rig_of(case).truth, TRUTH_NAMES[cause.number]))
    typed = float(getattr(start_plant(case).parameters, cause.number))
    return abs(value - true) <= TAKEN_BACK * abs(typed - true)


def _matches(cause: SetupCause, finding: Mapping[str, Any]) -> bool:
    others = [str(name) for name in finding.get("cannot_be_told_from") or ()]
    if finding["kind"] == cause.kind and _same_number(cause.number, str(finding["number"])):
        return True
    words = PLACES.get(cause.number, (cause.number,))
    return any(
        (cause.kind in other or cause.kind == "plant_constant") and _touches(other, words)
        for other in others
    )


def _same_number(mine: str, theirs: str) -> bool:
    return not mine or any(word in theirs for word in PLACES.get(mine, (mine,)))


def false_findings(case: HostileCase, said: Said) -> list[str]:
    """Return set-up findings that are neither true nor said to be the same as the truth."""
    true = (*case.answer.setup, *case.answer.also)
    found = []
    for finding in said.findings:
        number = str(finding["number"])
        if finding["kind"] in (*case.answer.noise, *case.answer.heard):
            continue
        if any(_matches(cause, finding) for cause in true):
            continue
        others = {str(name) for name in finding.get("cannot_be_told_from") or ()}
        names = {*case.answer.effects, *case.effects, *case.answer.equal, *FITTED}
        if others & names or (finding["kind"] == "plant_constant" and number in FITTED):
            continue
        if finding["kind"] == "skew" and any(cause.kind == "skew" for cause in true):
            continue  # two columns that are early are one that is late
        found.append(f"{finding['kind']} {number}")
    return found


def false_noise(case: HostileCase, said: Said) -> set[str]:
    """Return noise faults that are said and not there: shown beside the marks, not part of them."""
    true = {*case.answer.noise, *case.answer.heard, "coarse"}  # every converter has steps
    if {"dropouts", "outliers"} & true:
        true |= {"dropouts", "outliers"}
    return {word for word in NOISE_WORDS if word not in true and _is_fault_said(word, said)}


def _is_fault_said(word: str, said: Said) -> bool:
    return re.search(NOISE_WORDS[word], said.noise, re.IGNORECASE) is not None


def false_names(case: HostileCase, said: Said, covered: bool) -> set[str]:
    """Return the names of effects that are not there."""
    answer = case.answer
    true = {*answer.effects, *(n for n in case.effects if not answer.unknown), *answer.equal}
    if covered or any(_is_found(case, cause, said) for cause in answer.setup):
        true |= answer.beside
    hedged = {n for group in said.sets if group & true or _holds_truth(case, group) for n in group}
    return set(said.names) - true - hedged


def _holds_truth(case: HostileCase, group: frozenset[str]) -> bool:
    causes = {w for c in (*case.answer.setup, *case.answer.also) for w in (c.number, c.kind)}
    return any(_touches(entry, causes) for entry in group)


def _of_sets(case: HostileCase, said: Said) -> str:
    true = {*case.answer.effects, *case.effects, *case.answer.equal, *case.answer.beside}
    if all(group & true or _holds_truth(case, group) for group in said.sets):
        return "set"
    return "honest" if case.answer.near & said.names else "misled"


@dataclass(frozen=True)
class MarkedCase:
    """One examined case."""

    case: HostileCase
    document: Mapping[str, Any]
    seconds: float

    @property
    def mark(self) -> str:
        """How it went."""
        return mark(self.case, self.document)


def summarize(results: Sequence[MarkedCase]) -> dict[str, dict[str, float]]:
    """Return by group, and for all: cases, shares of right and honest, and the number of wrong."""
    groups = sorted({r.case.situation.group for r in results})
    table = {}
    for group in (*groups, "all"):
        marks = [r.mark for r in results if group in ("all", r.case.situation.group)]
        table[group] = {
            "cases": len(marks),
            "right": sum(m in RIGHT for m in marks) / max(len(marks), 1),
            "honest": sum(m in HONEST for m in marks) / max(len(marks), 1),
            "missed": sum(m in ("missed", "misled", "kin") for m in marks) / max(len(marks), 1),
            "wrong": sum(m == "wrong" for m in marks),
            "noise_not_there": sum(
                bool(false_noise(r.case, Said.of(r.document)))
                for r in results
                if group in ("all", r.case.situation.group)
            ),
        }
    return table
