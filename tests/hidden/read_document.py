"""A document of `pamctl diagnose` (schema 1 or 2) in the words that every core is scored by."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from hidden.hostile.lab import NOISE_WORDS
from hidden.rungs import Said

TERM_PLACES = {
    "command": "valve", "filling": "valve", "exhausting": "valve", "opening": "valve",
    "supply": "supply", "flow": "chamber", "leak": "chamber", "volume": "chamber",
    "damping": "friction", "braid_friction": "friction", "dry_friction": "friction",
    "pressure_sensor": "pressure_sensor", "pressure_pa": "pressure_sensor",
    "encoder": "encoder", "position_m": "encoder", "valve_v": "valve",
}  # fmt: skip
"""All others are forces. A law of a sensor or of the command is called after its column."""
TERM_KINDS = {"lag": "lag", "slew": "lag", "play": "memory", "hysteresis": "memory"}
PLACES = {"air": "chamber", "pull": "force"}
"""Of schema 2, where the words differ."""
NUMBERS = {
    "valve": "valve_v", "supply": "supply", "chamber": "volume", "friction": "friction",
    "force": "stiffness", "pressure_sensor": "pressure_pa", "encoder": "position_m",
}  # fmt: skip


def read_document(document: Mapping[str, Any]) -> Said:
    """Return what a document says."""
    if document["verdict"] == "bad_data":
        return Said(refusal=str(document.get("reason") or document["sentence"]))
    groups = [frozenset(_label(str(n)) for n in group) for group in document["ambiguous"]]
    findings = [f for f in document.get("setup") or () if f["kind"] != "filtered"]
    numbers = dict(_numbers_of(document))
    for f in findings:
        equals = [_label(str(n)) for n in f.get("cannot_be_told_from") or ()]
        groups += [frozenset({_call(f), *equals})] if equals else []
    sets = tuple(dict.fromkeys(group for group in groups if len(group) > 1))
    names = {e["name"] for e in document["effects"]}
    names |= {_call(f) for f in findings}
    places = set()
    for term in document["terms"] or ():
        places.add(_where_of_term(term["location"], term["operator"], term["driver"]))
    for known in document.get("places") or ():  # schema 2
        kind = known["kind"] or ""
        in_time = "time" in kind or kind == "onset"
        kind = kind and TERM_KINDS.get(kind, kind if kind in ("lag", "memory") else "")
        kind = kind or ("time" if in_time else "curve" if known["kind"] else "")
        places.add((PLACES.get(known["place"], known["place"]), kind))
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
    if kind == "added":  # the atmosphere was added to what was no gauge pressure
        return f"gauge.{finding['number']}"
    of_command = kind in ("null_offset", "decimated_command")
    return f"{kind}.{'command' if of_command else finding['number']}"


def _where_of_term(location: str, operator: str, driver: str) -> tuple[str, str]:
    in_time = driver == "time"
    kind = TERM_KINDS.get(operator, "time" if in_time else "curve")
    return TERM_PLACES.get(location, "force"), kind


def _label(words: str) -> str:
    """Return the word for a member of a set: an effect, a fault, or a law at its place."""
    if law := re.fullmatch(r"(\w+) of (\w+) over (\w+)", words):
        operator, location, driver = law.groups()
        if operator == "onset" and location == "leak":
            return "change_at_instant.chamber_leak"
        place, kind = _where_of_term(location, operator, driver)
        found = {"lag": "skew", "time": "drift"}.get(kind, "curve")
        return f"{found}.{NUMBERS[place]}"
    kind, of, number = words.partition(" of ")
    if not of:
        return words.split(":")[0]
    fault = {"clock": "clock_rate", "filter": "filtered"}.get(kind, kind.replace(" ", "_"))
    return f"{fault}.{number}"


def _numbers_of(document: Mapping[str, Any]) -> Iterator[tuple[str, tuple[float, float, float]]]:
    for effect in document["effects"]:
        for name, n in effect["parameters"].items():
            yield f"{effect['name']}.{name}", (n["value"], *(n.get("ci90") or (n["value"],) * 2))
    for name, n in document["recalibrated"].items():
        yield name, (n["value"], *(n.get("ci90") or (n["value"],) * 2))
