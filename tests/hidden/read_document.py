"""A document of `pamctl diagnose` (schema 1) in the words that every core is scored by."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from hidden.hostile.causes import NOISE_WORDS
from hidden.rungs import Said

TERM_PLACES = {
    "command": "valve", "filling": "valve", "exhausting": "valve", "opening": "valve",
    "supply": "supply", "flow": "chamber", "volume": "chamber", "damping": "friction",
    "braid_friction": "friction", "dry_friction": "friction", "pressure_sensor": "pressure_sensor",
    "encoder": "encoder",
}  # fmt: skip
"""All others are forces."""
TERM_KINDS = {"lag": "lag", "slew": "lag", "play": "memory", "hysteresis": "memory"}


def read_document(document: Mapping[str, Any]) -> Said:
    """Return what a document of schema 1 says."""
    if document["verdict"] == "bad_data":
        return Said(refusal=str(document.get("reason") or document["sentence"]))
    groups = [frozenset(_label(str(n)) for n in group) for group in document["ambiguous"]]
    findings = [f for f in document.get("setup") or () if f["kind"] != "filtered"]
    numbers = dict(_numbers_of(document))
    for f in findings:
        equals = [_label(str(n)) for n in f.get("cannot_be_told_from") or ()]
        groups += [frozenset({_call(f), *equals})] if equals else []
    sets = tuple(group for group in groups if len(group) > 1)
    names = {e["name"] for e in document["effects"]}
    names |= {_call(f) for f in findings}
    places = set()
    for term in document["terms"] or ():
        place = TERM_PLACES.get(term["location"], "force")
        kind = TERM_KINDS.get(term["operator"], "time" if term["driver"] == "time" else "curve")
        places.add((place, kind))
    return Said(
        frozenset(names - frozenset().union(*sets)), sets, frozenset(places), numbers,
        noise=frozenset(_faults_of(document.get("noise") or {})),
        admits=document["verdict"] == "none_known",
    )  # fmt: skip


def _faults_of(noise: Mapping[str, Any]) -> Iterator[str]:
    for about in noise.values():
        if about.get("source") == "unknown":  # what was filtered has no noise to be measured
            yield "noise.filtered"
        for fault in about.get("faults") or ():
            said = fault if isinstance(fault, str) else " ".join(map(str, fault.values()))
            for word, pattern in NOISE_WORDS.items():
                if re.search(pattern, said, re.IGNORECASE):
                    yield f"noise.{word}"


def _call(finding: Mapping[str, Any]) -> str:
    kind = finding["kind"]
    of_command = kind in ("null_offset", "decimated_command")
    return f"{kind}.{'command' if of_command else finding['number']}"


def _label(words: str) -> str:
    kind, of, number = words.partition(" of ")
    return f"{kind.replace(' ', '_')}.{number}" if of else words


def _numbers_of(document: Mapping[str, Any]) -> Iterator[tuple[str, tuple[float, float, float]]]:
    for effect in document["effects"]:
        for name, n in effect["parameters"].items():
            yield f"{effect['name']}.{name}", (n["value"], *(n.get("ci90") or (n["value"],) * 2))
    for name, n in document["recalibrated"].items():
        yield name, (n["value"], *(n.get("ci90") or (n["value"],) * 2))
